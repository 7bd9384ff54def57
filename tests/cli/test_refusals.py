"""What is refused: the exit code, one message that says what is wrong, where and what is allowed, nothing written."""

import re
import shutil
import sqlite3

import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import ExitCode
from tests.cli.conftest import contents
from tests.cli.records import TINY

MISSPELT = TINY.replace("clock_period", "clok_period").replace("interval: 0.1", "interval: -1")
FILES = {
    "misspelt.yaml": MISSPELT,
    "second.yaml": TINY.replace("seed: 1", "seed: one"),
    "copy.yaml": TINY,
    "broken.yaml": "experiment: [",
    "colours.yaml": '"\\e[2J": 1\n"\\u202e": 2\n',
    "constant.csv": "t,y\n" + "".join(f"{0.1 * k:.1f},4\n" for k in range(50)),
    "weeks.csv": "t [fortnights],y\n0,1\n1,2\n",
    "short.csv": "t [s],u [V],y [mm]\n0,1,0\n0.1,1,1\n0.2,0,1\n",
    "ms.csv": "t [ms],u [V],y [mm]\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(50)),
    "order.json": '{"kind": "ctid order"}',
    "newer.json": '{"kind": "ctid fit", "format": 99, "ctid": "9.0"}',
    "changed.json": '{"kind": "ctid fit", "format": 2, "checksum": "0"}',
}

REFUSED = {
    ExitCode.BAD_INPUT: """\
        validate misspelt.yaml second.yaml
        run misspelt.yaml second.yaml
        validate broken.yaml
        validate colours.yaml
        validate nowhere.yaml
        run tiny.yaml copy.yaml
        run tiny.yaml --set noise.snr=5
        run tiny.yaml --set noise
        run tiny.yaml --set sampling.samples=3
        run measured-tiny.yaml --set data.file=none.csv
        run measured-tiny.yaml --set data.file=/dev/null
        run measured-tiny.yaml --set data.file=/dev/null --allow-outside
        run loop.yaml --set loop.controller.pid.kp=0.575
        run tiny.yaml --shard 4/3
        run tiny.yaml --keep-readable
        run tiny.yaml --time-budget soon
        run
        run tiny.yaml --jobs 0
        run tiny.yaml --runs some
        run tiny.yaml --jobs 2 -j 3
        table --format md --format=md
        check x.csv --time a --time b
        table --format word
        shwo abc
        accuracy measured-tiny.yaml
        accuracy misspelt.yaml
        init mesured
        schema noise
        schema --text nose
        status tinny
        table 9
        table tinny --compare search,known
        table tiny --compare search,known
        table tiny --compare search,known --measure bias
        table tiny --measure coverge
        table --measure bias
        table tiny --out nowhere
        export
        export tinny
        export tiny --format md
        export tiny --as scipy
        export --id zz
        export p2/fit.json
        export p2/fit.json --as scipy --pade 3
        merge nowhere
        verify --out nowhere
        figure measured-tiny
        figure tiny --kind cloud
        figure tiny --measure rsme
        figure tinny
        figure 1 8
        figure 1 --format png
        figure tiny 1 --file a.svg
        figure additive/2 additive/coverage --out nowhere
        report tinny
        report none.json
        report order.json
        report record.csv
        report p1/fit.json --record other.csv
        report p1/fit.json --validate other.csv
        report track/track.json --validate other.csv
        report track/track.json --record other.csv --record tones.csv
        report tiny --record record.csv
        compare newer.json --on other.csv
        compare changed.json --on other.csv
        compare order.json --on other.csv
        compare p1/fit.json p1/fit.json --on other.csv
        compare p1/fit.json --on ms.csv
        compare p1/fit.json --on other.csv --input fan
        compare p1/fit.json --on short.csv
        compare p1/fit.json --on missing.csv
        compare p1/fit.json --on p1/comparison.csv --out p1
        frf record.csv --period 1000
        frf record.csv --method periodic
        frf record.csv --width 2
        frf record.csv --width 8 --segment 100
        frf record.csv --method welch --period 100
        frf short.csv
        track constant.csv --tones 1
        track weeks.csv
        track record.csv --signal z
        track tones.csv --tones many
        track tones.csv --tones 65
        track tones.csv --every -1
        track tones.csv --accuracy 0
        track tones.csv --window 1000
        track tones.csv --rate 0
        track tones.csv --rate 5 --interval 2
        track tones.csv --from nan
        track tones.csv --from 100
        track tones.csv --from 0.1 --to 0.11
        track track/track.csv --out track
        reproduce addition
        reproduce --check --publish
        run 9999999999999999999999999999999999999999999999999999999999999999.yaml""",
    ExitCode.REFUSED: """\
        init open-loop modes
        run tiny.yaml --out taken
        run tiny.yaml --out newer
        table tiny --out newer
        status tiny --out newer
        export tiny --out newer""",
    ExitCode.STORAGE: """\
        figure 1 --file record.csv/x.svg
        track tones.csv --tones 2 --out record.csv/deeper
        export tiny --file record.csv/x.csv""",
    ExitCode.DIFFERENCE: """\
        verify --out damaged
        reproduce --check coverage --out nowhere""",
}
CASES = [(line.strip(), code) for code, lines in REFUSED.items() for line in lines.splitlines()]


@pytest.fixture(scope="module")
def prepared(used):
    """The used folder with bad files, and with results of another experiment, of a newer format, and damaged."""
    for name, text in FILES.items():
        (used / name).write_text(text, encoding="utf-8")
    (used / "modes.yaml").write_text("mine", encoding="utf-8")
    shutil.copy(used / "other.csv", used / "p1" / "comparison.csv")
    shutil.copytree(used / "results" / "measured-tiny", used / "taken" / "tiny")
    for name in ("newer", "damaged"):
        shutil.copytree(used / "results" / "tiny", used / name / "tiny")
    with sqlite3.connect(used / "newer" / "tiny" / "journal.sqlite") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    (used / "damaged" / "tiny" / "runs.h5").write_bytes(b"no file of HDF5")
    return used


@pytest.mark.parametrize(("command", "code"), CASES, ids=[command for command, _ in CASES])
def test_one_message_and_nothing_is_written(prepared, monkeypatch, snapshot, command, code):
    monkeypatch.chdir(prepared)
    before = contents(prepared)
    done = CliRunner().invoke(app, command.split())
    assert done.exit_code == code, done.output
    assert contents(prepared) == before
    assert done.stdout == "" or code == ExitCode.DIFFERENCE
    assert done.stderr.replace(str(prepared), "HERE") == snapshot
    assert done.stderr.isprintable() or re.fullmatch(r"[^\x00-\x09\x0b-\x1f\u202e]*", done.stderr)
