"""All campaigns in full, and the table of what they brought about: ``make faults``.

The shares scale with the number of fuzzed inputs, of which 20,000 are the full form.
"""

import argparse
import tempfile
from pathlib import Path

from tests.faults import damage, process_faults, storage_faults
from tests.faults.conftest import STORED, TINY
from tests.faults.counts import Count, table
from tests.faults.harness import Fuzzer, faults
from tests.faults.test_faults import KINDS
from tests.storage.sealed_images import read_sealed, seal_image

#: Trials of the full form.
INPUTS, STORAGE, DAMAGES = 20_000, 2_600, 360


def fuzzed(inputs: int, begin: int) -> list[Count]:
    """Counts of the kinds of inputs that nobody meant to write."""
    counts = []
    images = []
    for folder in sorted(STORED.iterdir()):
        runs = read_sealed(folder / "runs.h5")
        images.append(seal_image(runs.manifest, runs.origins, runs.results)[0])
    with tempfile.TemporaryDirectory(prefix="fuzz-") as place:
        fuzzer = Fuzzer(Path(place), images, TINY, commands_every=50)
        for kind, share in KINDS.items():
            count = Count(f"fuzzed input: {kind}")
            numbers = range(int(begin * share), int((begin + inputs) * share))
            found = faults(fuzzer, kind, numbers)
            for number in numbers:
                text = found.get(number, "")
                count.add([("hang" if text.startswith("hangs") else "traceback", text)] if text else [], number)
            counts.append(count)
    return counts


def main() -> int:
    """Run all campaigns; prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the full form")
    parser.add_argument("--begin", type=int, default=0, help="go on with others: so many inputs are left out")
    options = parser.parse_args()
    share, first = options.share, options.begin
    later = round(first / INPUTS * STORAGE)
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        counts = storage_faults.run_under(Path(folder), round(share * STORAGE), later)
    counts += process_faults.campaign(share, first)
    counts += damage.campaign(round(share * DAMAGES), first)
    counts += fuzzed(round(share * INPUTS), first)
    print(table(counts))
    for count in counts:
        print("\n".join(count.examples))
    return 0 if all(count.is_good for count in counts) else 1


if __name__ == "__main__":
    raise SystemExit(main())
