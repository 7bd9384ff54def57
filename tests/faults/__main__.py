"""All campaigns, and the table of what they brought about: ``make faults``.

What was tried is kept in a folder, so that a later call goes on where an earlier one was stopped.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

from tests.faults.campaigns import CAMPAIGNS, ROOT, Campaign
from tests.faults.record import Record, published, refusal

PUBLISHED = ROOT / "results" / "published" / "faults"


def numbers(record: Record, campaign: Campaign, options: argparse.Namespace, until: float) -> Iterator[int]:
    """What of a campaign is to be tried, as long as there is time."""
    part, parts = map(int, options.part.split("/"))
    at_most = round(options.share * campaign.trials)
    for number in record.failed(campaign) if options.again else record.missing(campaign, at_most):
        if monotonic() > until:
            return
        if number % parts == part - 1:
            yield number


def main() -> int:
    """Run campaigns; prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "faults", help="where trials are kept")
    parser.add_argument("--share", type=float, default=1.0, help="how much of the full form; 2: others after it")
    parser.add_argument("--only", default="", help="campaigns, by comma")
    parser.add_argument("--part", default="1/1", help="for several processes at once: 1/2 here, 2/2 there")
    parser.add_argument("--again", action="store_true", help="repeat the trials that brought about what must not be")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after this time; call it again to go on")
    parser.add_argument("--publish", action="store_true", help="write what came of it to results/published")
    options = parser.parse_args()
    until = monotonic() + 60 * options.minutes
    names = options.only.split(",") if options.only else [campaign.name for campaign in CAMPAIGNS]
    record = Record(options.folder)
    record.begin()
    for campaign in CAMPAIGNS:
        if campaign.name not in names:
            continue
        chosen = numbers(record, campaign, options, until)
        for tried, trial in enumerate(campaign.tried(chosen), 1):
            record.add(campaign, trial)
            if trial.found or tried % 100 == 0:
                print(trial if trial.found else f"{campaign.name}: {tried} tried", file=sys.stderr, flush=True)
    # Other sittings may have added to it.
    record = Record(options.folder)
    texts = record.texts()
    published(options.folder, texts)
    print(texts["faults.md"])
    if options.publish:
        if why := refusal(record):
            print(f"nothing is published: {why}", file=sys.stderr)
            return 2
        published(PUBLISHED, texts)
    return 0 if all(count.is_good for count in record.counts()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
