"""What a damaged write-ahead log has lost is noticed."""

from pathlib import Path

import pytest

from ctid_cli.errors import DamageError
from ctid_cli.storage.announcement import announce
from ctid_cli.storage.folder import reading_journal
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.verify import verify
from tests.storage.made_results import ORIGIN, outcomes_of, plan_of

MANIFEST = plan_of(5).manifest()


@pytest.mark.parametrize("kept", [0.0, 0.5])
def test_estimates_that_were_reported_and_are_lost_with_the_log_are_noticed(tmp_path: Path, kept: float) -> None:
    place, dead = tmp_path / "toys", tmp_path / "dead"
    place.mkdir()
    dead.mkdir()
    log = open_journal(place / "journal.sqlite")
    session = log.begin(MANIFEST, ORIGIN, "now", {})
    for outcome in outcomes_of(MANIFEST):
        log.add([outcome], session)
    announce(place, "toys", "now", 5, 5, log.count())
    for name in ("journal.sqlite", "journal.sqlite-wal", "running.json"):
        (dead / name).write_bytes((place / name).read_bytes())
    log.close()
    assert verify(dead).is_intact
    data = bytearray((dead / "journal.sqlite-wal").read_bytes())
    data[int(len(data) * kept) + 100] ^= 255
    (dead / "journal.sqlite-wal").write_bytes(data)
    assert not verify(dead).is_intact
    with pytest.raises(DamageError, match="is damaged"):
        _read_all(dead)
    with pytest.raises(DamageError, match="is damaged"):
        open_journal(dead / "journal.sqlite")


def _read_all(folder: Path) -> None:
    with reading_journal(folder) as log:
        assert log is not None
        log.check()
