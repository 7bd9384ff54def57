"""Share of small faults in the sources that the tests find: with the unmarked tests, and with all of them.

python benchmarks/mutants.py [--seed 1] [--each 10] [--list]

Ten mutants of each of three parts of the package: estimation, the runner, inference and identification. A mutant
changes one operator, comparison, constant or condition of a line that is executed by a test. The tests that execute the
line, as recorded in ``.coverage``, are run with ``-x``: the unmarked ones first, and for the survivors those marked
slow. Install pytest-cov, which nothing else needs, and make the record by

    .venv/bin/python -m pytest -q -n 2 --dist loadfile -m "" --cov ctid_cli --cov-branch --cov-context=test \
        --cov-report=

The sources are changed in a copy of the checkout, never here. Processor time: several minutes for each survivor.
"""

import argparse
import ast
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "estimation": ("estimation", "estimators"),
    "runner": ("running", "storage"),
    "inference and identification": ("inference", "identification"),
}
#: Operators, and what takes their place.
SWAPS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


def places(tree):
    """Yield every node that can be changed, with a function that changes it; type hints and defaults are no places."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        for inner in (part for statement in node.body for part in ast.walk(statement)):
            if isinstance(inner, ast.BinOp | ast.BoolOp) and type(inner.op) in SWAPS:
                yield inner, lambda at: setattr(at, "op", SWAPS[type(at.op)]())
            elif isinstance(inner, ast.Compare) and type(inner.ops[0]) in SWAPS:
                yield inner, lambda at: at.ops.__setitem__(0, SWAPS[type(at.ops[0])]())
            elif isinstance(inner, ast.Constant) and type(inner.value) in (int, float):
                yield inner, lambda at: setattr(at, "value", at.value + 1)
            elif isinstance(inner, ast.If | ast.IfExp | ast.While):
                yield inner.test, lambda at: at
            elif isinstance(inner, ast.UnaryOp) and isinstance(inner.op, ast.Not | ast.USub):
                yield inner, lambda at: at


def changed(source, number):
    """Return the source with its place of that number changed, the line, and a description."""
    tree = ast.parse(source)
    node, change = list(places(tree))[number]
    before = ast.unparse(node)
    if isinstance(node, ast.UnaryOp):
        replacement = f"({ast.unparse(node.operand)})"
    else:
        change(node)
        replacement = f"({ast.unparse(node)})"
        if replacement == f"({before})":
            replacement = f"(not ({before}))"
    lines = source.split("\n")
    # Offsets count bytes.
    first, last = node.lineno - 1, node.end_lineno - 1
    head = lines[first].encode()[: node.col_offset].decode()
    tail = lines[last].encode()[node.end_col_offset :].decode()
    lines[first : last + 1] = [head + replacement + tail]
    return "\n".join(lines), node.lineno, f"{before}  ->  {replacement[1:-1]}"


class Record:
    """Which tests execute a line, from the database of coverage."""

    def __init__(self, file):
        self.base = sqlite3.connect(file)

    def tests_of(self, path, line):
        """Return the identifiers of the tests that execute a line."""
        rows = self.base.execute(
            "select distinct context.context from arc join context on context.id = arc.context_id join file on "
            "file.id = arc.file_id where file.path like ? and abs(arc.tono) = ?",
            (f"%/{path}", line),
        )
        return sorted({context.rpartition("|")[0] for (context,) in rows if "|" in context})


def drawn(record, part, count, rng):
    """Yield mutants of executed lines: path, changed source, line, description, tests."""
    files = [file for folder in PARTS[part] for file in sorted((ROOT / "ctid_cli" / folder).rglob("*.py"))]
    files = [file for file in files if "njit" not in file.read_text(encoding="utf-8")]
    every = [(file, k) for file in files for k in range(len(list(places(ast.parse(file.read_text(encoding="utf-8"))))))]
    rng.shuffle(every)
    for file, number in every:
        path = file.relative_to(ROOT).as_posix()
        source, line, what = changed(file.read_text(encoding="utf-8"), number)
        tests = record.tests_of(path, line)
        try:
            compile(source, path, "exec")
        except SyntaxError:
            continue
        if tests:
            yield path, source, line, what, tests
            count -= 1
        if not count:
            return


def kills(copy, tests, mark):
    """Return whether one of the tests fails, and None if none has the mark."""
    words = ["-x", "-q", "-n", "logical", "--dist", "loadfile", "-p", "no:cacheprovider", "-m", mark, *tests]
    # Bytecode of an earlier mutant may have the same size and time stamp.
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", *words]
    done = subprocess.run(command, cwd=copy, capture_output=True, env=environment, timeout=3600)
    return None if done.returncode == 5 else done.returncode != 0


def main():
    """Print each mutant with its fate, and the shares."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=10)
    parser.add_argument("--list", action="store_true", help="Only show the mutants.")
    options = parser.parse_args()
    record, rng, fates = Record(ROOT / ".coverage"), random.Random(options.seed), []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        kept = shutil.ignore_patterns(".git", ".venv", "build", "*.pyc")
        shutil.copytree(ROOT, copy, ignore=kept)
        for part in PARTS:
            for path, source, line, what, tests in drawn(record, part, options.each, rng):
                fate = "listed"
                if not options.list:
                    original = (copy / path).read_text(encoding="utf-8")
                    (copy / path).write_text(source, encoding="utf-8")
                    quick = kills(copy, tests, "not slow")
                    fate = "killed" if quick else "killed by slow tests" if kills(copy, tests, "slow") else "survived"
                    (copy / path).write_text(original, encoding="utf-8")
                fates.append(fate)
                print(f"{fate:22} {path}:{line}  {what}  ({len(tests)} tests)", flush=True)
    if not options.list:
        quick, slow = fates.count("killed"), fates.count("killed by slow tests")
        print(f"{len(fates)} mutants; {quick + slow} killed by all tests, {quick} of them by the unmarked ones")


if __name__ == "__main__":
    main()
