"""Continuous PID gains: limits, discretisation rules, and equivalent gains per sample."""

import numpy as np
import pytest

from ctid_cli.models.controller import ContinuousPid

FULL = {"kp": 2.0, "ti": 5.0, "td": 0.4, "filter_time": 0.05}


@pytest.mark.parametrize("rule", ["backward_euler", "tustin"])
@pytest.mark.parametrize(
    "options", [FULL, {"kp": 2.0, "ti": 3.0}, {"kp": 1.0, "kd": 0.3, "filter_time": 0.1}, {"ki": 0.7}]
)
def test_the_rule_puts_its_map_in_the_place_of_s(rule, options):
    pid, h = ContinuousPid(**options, discretisation=rule), 0.1
    w = np.array([0.05, 0.7, 6.0, 25.0])
    q = np.exp(1j * w * h)
    s = (q - 1) / (h * q) if rule == "backward_euler" else 2 * (q - 1) / (h * (q + 1))
    filtered = pid.derivative_gain * s / (pid.filter_time * s + 1)
    expected = pid.kp + pid.integral_gain / s + filtered
    np.testing.assert_allclose(pid.discrete(h).frequency_response(w, h), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kp": 1.0, "ti": 2.0, "ki": 0.5}, "ti and ki set the same gain; keep one"),
        ({"kp": 1.0, "td": 2.0, "kd": 0.5}, "td and kd set the same gain"),
        ({"kp": 1.0, "ti": 0.0}, r"ti must be a positive number \[s\]"),
        ({"ki": np.inf}, r"ki must be a finite number \[input unit/\(output unit s\)\]"),
        ({"kd": 1.0, "discretisation": "tustin"}, "filter_time must be above 0 s"),
        ({"kp": 1.0, "discretisation": "zoh"}, "discretisation must be 'backward_euler' or 'tustin', not 'zoh'"),
        ({"kp": 1.0, "filter_time": -1.0}, "filter_time must be zero or a positive number"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ContinuousPid(**options)
