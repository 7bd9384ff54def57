"""One pass over a record, ns of processor time per sample, compared with the same pass in C, compiled here.

    python benchmarks/bench_passes.py

Ours also finds the poles, the partial fractions and the map to the standard rows; the reference is given the poles.
Without a C compiler only our times are printed.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

from _timing import least

import numpy as np
from bench_srivc_iteration import CASES, noisy_record

from ctid_cli.filtering.bank import modal_form, second_moments
from ctid_cli.filtering.filter_data import filter_data, split_delay
from ctid_cli.filtering.kernels import step_weights

REPEATS = 200


def compiled(compiler, modes, folder):
    """Compile the reference for a number of pole pairs."""
    library = Path(folder) / f"pass{modes}.so"
    source = Path(__file__).with_name("pass_reference.c")
    flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", f"-DMODES={modes}"]
    subprocess.run([compiler, *flags, "-o", library, source, "-lm"], check=True)
    return ctypes.CDLL(str(library))


def reference(library, data, poles, residues, delay):
    """Return a call of the reference, and its output array."""
    gram = np.zeros((6 * poles.size + 2,) * 2)

    def address(array):
        return ctypes.c_void_p(array.ctypes.data)

    clock = [address(data.u), address(data.y), ctypes.c_long(data.y.size)]
    if data.interval:
        shift, fraction = split_delay(delay, data.interval)
        lengths = data.interval, data.interval * fraction
        weights = [np.array([step_weights(pole, length) for pole in poles]) for length in lengths]
        late = [ctypes.c_long(shift), ctypes.c_int(fraction > 0)]
        arguments = [*clock, *late, *map(address, weights), address(residues), address(gram)]
        return lambda kept=weights: library.regular(*arguments), gram
    rest = [ctypes.c_double(delay), address(poles), address(residues), address(gram)]
    return lambda: library.irregular(address(data.t), *clock, *rest), gram


def main():
    compiler = shutil.which("cc")
    print(f"{'system':8}{'clock':11}{'delay':16}{'ours':>7}{'C':>7}{'ratio':>7}   ns a sample")
    with tempfile.TemporaryDirectory() as folder:
        for name, system, samples, interval, _ in CASES:
            a, b = system.denominator, system.numerator
            form = modal_form(a, b)
            poles, residues = form.poles, np.ascontiguousarray(form.residues[:, 0])
            # The last row of the reference is the error, after the filtered output.
            size = form.mapping.shape[1]
            order = [*range(4 * poles.size + 1), size - 1, *range(4 * poles.size + 1, size - 1)]
            library = compiled(compiler, poles.size, folder) if compiler else None
            for regular, clock in ((True, "regular"), (False, "irregular")):
                data = filter_data(noisy_record(system, samples, interval, regular))
                for delay, said in ((8.0, "whole intervals"), (8.0 + 0.37 * interval, "off the clock")):
                    calls = [lambda: second_moments(data, a, b, delay)]  # noqa: B023
                    if library:
                        call, gram = reference(library, data, poles, residues, delay)
                        calls.append(call)
                        call()
                        whole = np.triu(gram) + np.triu(gram, 1).T
                        theirs = form.mapping @ whole[np.ix_(order, order)] @ form.mapping.T
                        np.testing.assert_allclose(theirs, calls[0](), rtol=1e-6, atol=1e-9 * np.abs(theirs).max())
                    times = 1e9 * least(REPEATS, *calls) / samples
                    others = f"{times[1]:7.1f}{times[0] / times[1]:7.2f}" if library else ""
                    print(f"{name:8}{clock:11}{said:16}{times[0]:7.1f}{others}", flush=True)


if __name__ == "__main__":
    main()
