"""Inputs that nobody meant to write: specifications, data files, results and command lines, from fixed seeds.

Every input is made from its kind and its number alone, so that a failure can be made again.
"""

import contextlib
import io
import json
import random
import zlib
from pathlib import Path

import h5py
import numpy as np
import scipy.io

ROOT = Path(__file__).parents[2]

#: Values that programs stumble over.
NUMBERS = (
    *("0", "-0", "1", "-1", "2", "1e308", "-1e308", "1e-308", "5e-324", "1e400", "1e-301", "1e-400", ".nan", ".inf"),
    *("-.inf", "9223372036854775807", "9223372036854775808", "-9223372036854775809", "1e9", "1000000000", "1e15"),
    *("0.1", "3.5", "010", "0x1F", "1_000", "1:30", "9" * 500, "1e", "+", "--1", "½", "٣"),
)
TEXTS = (
    *(
        '""',
        "null",
        "~",
        "true",
        "false",
        "[]",
        "{}",
        "[[]]",
        "[1, 2, 3]",
        "{a: 1}",
        "text",
        "none",
        "../../etc/passwd",
    ),
    *(
        "/dev/zero",
        "/proc/self/environ",
        "'\\0'",
        '"\\0"',
        '"\\e[2J"',
        '"\\uD800"',
        "'" + "x" * 3000 + "'",
        "!!python/object",
    ),
    *("!!binary aGk=", "*nowhere", "&a [*a]", "2020-01-01", "<<: {}", "- 1", "? a", "|", ">", "@", "`", "%", "kind: x"),
    *("{kind: white}", "{kind: prbs}", "{kind: './x.py:X'}", "{uniform: [0, 1]}", "{geometric: [1, 2, 1000000000]}"),
)


def specifications() -> list[bytes]:
    """Specifications that are right."""
    files = [*sorted(ROOT.glob("configs/**/*.yaml")), *sorted(ROOT.glob("ctid_cli/templates/*.yaml"))]
    # The small ones: mutations of large ones test the same code and take longer.
    return [file.read_bytes() for file in files if file.stat().st_size < 4000]


def rng_of(kind: str, number: int) -> random.Random:
    """The random numbers of one input."""
    return random.Random(zlib.crc32(f"{kind}/{number}".encode()))


def mutated_bytes(rng: random.Random, data: bytes, at_most: int = 4) -> bytes:
    """Bytes changed, cut out, doubled, or put in."""
    found = bytearray(data)
    for _ in range(rng.randint(1, at_most)):
        k, n = rng.randrange(len(found) + 1), rng.choice((1, 1, 2, 4, 8, 40))
        match rng.randrange(6):
            case 0:
                found[k : k + n] = rng.randbytes(n)
            case 1:
                del found[k : k + n]
            case 2:
                found[k:k] = found[k : k + n]
            case 3:
                found[k:k] = rng.choice(
                    (b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n", b"\t", b"\x1b[2J", b"\xed\xa0\x80")
                )
            case 4:
                found[k : k + 4] = rng.choice((0, 2**31 - 1, 2**31, 2**32 - 1)).to_bytes(4, "little")
            case 5:
                del found[k:]
        found = found or bytearray(b"\0")
    return bytes(found)


def mutated_yaml(rng: random.Random, data: bytes) -> bytes:
    """A specification with values, keys and lines that were not meant."""
    lines = data.decode().splitlines()
    for _ in range(rng.randint(1, 3)):
        k = rng.randrange(len(lines))
        head, colon, _ = lines[k].partition(":")
        match rng.randrange(9):
            case 0 | 1 | 2:
                lines[k] = f"{head}{colon} {rng.choice(NUMBERS + TEXTS)}"
            case 3:  # one value within a line
                words = lines[k].split(" ")
                j = rng.randrange(len(words))
                words[j] = rng.choice(NUMBERS + TEXTS) + ("," if words[j].endswith(",") else "")
                lines[k] = " ".join(words)
            case 4:
                del lines[k]
            case 5:
                lines.insert(k, lines[rng.randrange(len(lines))])
            case 6:
                lines[k] = " " * rng.randint(1, 5) + lines[k]
            case 7:
                lines[k] = lines[k].replace(":", rng.choice((": &x", ":", ": *x", " :", "::")), 1)
            case 8:
                return mutated_bytes(rng, "\n".join(lines).encode())
        lines = lines or [""]
    text = "\n".join(lines)
    if rng.random() < 0.05:
        return text.encode(rng.choice(("utf-16", "utf-32", "utf-8-sig")))
    return text.replace("\n", "\r\n").encode() if rng.random() < 0.05 else text.encode()


def record(rng: random.Random) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a small record, as text."""
    n = rng.choice((1, 2, 3, 8, 40, 60))
    scale = rng.choice((1.0, 1.0, 1.0, 1e300, 1e-300, 1e59, 1e-59))
    step = rng.choice((0.1, 0.1, 0.1, 1e-301, 1e-20, 1e20, 1e300))
    draw = np.random.default_rng(rng.randrange(2**32))
    t, u = step * np.arange(n), np.sign(draw.standard_normal(n))
    y = scale * (np.convolve(u, [0.1, 0.2, 0.1])[:n] + 0.01 * draw.standard_normal(n))
    return ["t", "u", "y"], [[repr(float(v)) for v in row] for row in zip(t, u, y, strict=True)]


def csv_file(rng: random.Random) -> bytes:
    """A comma-separated record in which something is odd."""
    header, rows = record(rng)
    for _ in range(rng.randint(0, 3)):
        k, j = rng.randrange(len(rows)), rng.randrange(3)
        match rng.randrange(7):
            case 0 | 1:
                rows[k][j] = rng.choice((*NUMBERS, *TEXTS, "", "nan", "NA", "inf", '"', '"1"', "1,5", "1;5"))
            case 2:
                rows[k] = rows[k][: rng.randrange(4)]
                rows[k] += [""] * (3 - len(rows[k])) if rng.random() < 0.5 else []
                rows[k] = rows[k] if len(rows[k]) == 3 else [*rows[k], *["0"] * (3 - len(rows[k]))]
            case 3:
                header[j] = rng.choice(("", "time", "y", "u [V]", "t (ms)", "x" * 2000, "\x1b[31m", "1.5", "ü", "a\0b"))
            case 4:
                rows = [[row[0], "1", row[2]] for row in rows]
            case 5:
                rows = [[row[0], row[1], rng.choice(("0", "1e-320", "nan", "7"))] for row in rows]
            case 6:
                rows.insert(k, list(rows[k]))
    sign, end = rng.choice((",", ",", ",", ",", ";", "\t")), rng.choice(("\n", "\n", "\n", "\r\n", "\r"))
    data = end.join([sign.join(header), *(sign.join(row) for row in rows)]).encode()
    return mutated_bytes(rng, data) if rng.random() < 0.4 else data


def mat_file(rng: random.Random) -> bytes:
    """A MATLAB file, of version 5 or 7.3, in which something is odd."""
    _, rows = record(rng)
    columns = {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate("tuy")}
    odd = (
        np.array([1 + 2j]), np.zeros((0, 3)), np.array("text"), np.eye(2), np.array(["a", 1.0], dtype=object),
        np.array([True]), np.arange(3, dtype=np.uint8), {"t": columns["t"]}, np.array([np.nan]),
    )  # fmt: skip
    values = dict(columns)
    if rng.random() < 0.4:
        values[rng.choice("tuy")] = rng.choice(odd)
    stream = io.BytesIO()
    if rng.random() < 0.4:
        with h5py.File(stream, "w", userblock_size=512) as file:
            for name, value in values.items():
                if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufc":
                    file[name] = h5py.SoftLink(rng.choice(("/t", "/nowhere", f"/{name}")))
                elif rng.random() < 0.1:
                    file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
                elif rng.random() < 0.1:
                    file[name] = h5py.ExternalLink(rng.choice(("/dev/zero", "other.mat", "/etc/passwd")), "/t")
                else:
                    item = file.create_dataset(name, data=value)
                    item.attrs["MATLAB_class"] = np.bytes_(rng.choice(("double", "double", "char", "logical")))
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\x00\x02IM"
        data = head.ljust(512, b"\0") + stream.getvalue()[512:]
    else:
        scipy.io.savemat(stream, values, do_compression=rng.random() < 0.5)
        data = b"MATLAB 5.0 MAT-file".ljust(116) + stream.getvalue()[116:]  # without the time of day
    return mutated_bytes(rng, data) if rng.random() < 0.6 else data


def results_file(rng: random.Random, good: bytes, reseal) -> bytes:
    """A sealed file of which something was changed; mostly its checksums were made anew, so that they are right."""
    if rng.random() < 0.15:
        return mutated_bytes(rng, good)
    stream = io.BytesIO(good)
    with h5py.File(stream, "r+") as file:
        for _ in range(rng.randint(1, 3)):
            # What an earlier change has broken may stop a later one.
            with contextlib.suppress(TypeError, ValueError, KeyError, OSError, RuntimeError, MemoryError):
                (_change_plan if rng.random() < 0.5 else _change_column)(rng, file)
    return reseal(stream.getvalue())


def _change_plan(rng: random.Random, file: h5py.File) -> None:
    """Another value somewhere in the plan."""
    plan = json.loads(bytes(file["manifest"][()]))
    here = plan
    for _ in range(rng.randint(0, 4)):
        inner = [
            value
            for value in (here.values() if isinstance(here, dict) else here)
            if isinstance(value, (dict, list)) and value
        ]
        if not inner:
            break
        here = rng.choice(inner)
    odd = (
        None,
        0,
        -1,
        1.5,
        1e300,
        10**9,
        10**30,
        "",
        "x",
        "../../x",
        "\x1b[2J",
        [],
        {},
        [1],
        {"a": 1},
        True,
        "9" * 2000,
    )
    key = rng.choice(list(here)) if isinstance(here, dict) else rng.randrange(len(here))
    if rng.random() < 0.2:
        del here[key]
    else:
        here[key] = rng.choice(odd)
    text = np.array(
        json.dumps(plan).encode() if rng.random() < 0.95 else rng.choice((b"[" * 9000, b"{", b"NaN", b"\xff"))
    )
    del file["manifest"]
    file["manifest"] = text


def _change_column(rng: random.Random, file: h5py.File) -> None:
    """Another type, length, shape or value of one column, or an attribute."""
    group = file["estimates"]
    name = rng.choice([key for key in group if isinstance(group[key], h5py.Dataset)])
    values = group[name][()]
    attributes = dict(group[name].attrs)
    del group[name]
    match rng.randrange(9):
        case 0:
            values = values[: rng.randrange(len(values) + 1)]
        case 1:
            values = np.array([b"text"] * len(values))
        case 2:
            values = rng.choice((np.array(1.0), np.zeros((2, 2, 2)), np.zeros(0), np.full(len(values), np.nan)))
        case 3:
            group.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
            return
        case 4:
            group[name] = rng.choice((h5py.SoftLink("/estimates/delay"), h5py.ExternalLink("/etc/passwd", "/x")))
            return
        case 5:
            return
        case 6:
            values = np.array([*values, *values[:1]])
        case 7:
            values = np.full(np.shape(values), rng.choice((1e308, -1e308, 5e-324, np.inf, -7, 2**62)))
        case 8:
            file.attrs[rng.choice(list(file.attrs))] = rng.choice((0, "x", -1.5, np.zeros(3)))
    group.create_dataset(name, data=values)
    for key, text in attributes.items():
        group[name].attrs[key] = text


def arguments(rng: random.Random, commands: dict[str, list[str]], files: dict[str, str]) -> list[str]:
    """A command line of words that the command knows, and others."""
    words = (
        *NUMBERS,
        "",
        "x",
        "--",
        "-",
        "--help",
        "tiny",
        "1",
        "a,b",
        "0:1",
        "1:0",
        "=",
        "../..",
        "/dev/zero",
        "\x1b[2J",
        "ü",
        "\udcff",
    )
    name = rng.choice(list(commands))
    line = name.split()
    for _ in range(rng.randint(0, 5)):
        line.append(rng.choice((*commands[name], *files.values(), *words)))
    return line
