"""How an estimation ended, in a sentence for the user."""

from enum import Enum


class Status(Enum):
    """Outcome of an estimation: what happened, the usual cause, and what to change."""

    CONVERGED = "The iterations converged to a minimum of the output-error cost."
    LEAST_SQUARES = "A one-shot least-squares estimate: biased by output noise; use it as a start, not as a result."
    MAX_ITERATIONS = (
        "The iterations stopped at max_iterations before reaching the tolerance; raise max_iterations, or start closer."
    )
    STALLED = (
        "No step lowers the cost although no minimum is reached: too many parameters for these data, or a tolerance "
        "below what rounding allows; use fewer poles or zeros, or a larger tolerance."
    )
    AT_BOUND = (
        "The least output-error cost is at the border of the admissible models: a pole is as fast, as slow or as "
        "little damped as may be; use fewer poles, or a record that shows more of it."
    )
    RIDGE = (
        "The output-error cost is least and hardly changes along a line as far as models are admissible: the data do "
        "not determine all parameters; use fewer poles or zeros."
    )
    DELAY_AT_BOUND = "The delay stopped at one of its bounds; widen delay_bounds, or start the delay elsewhere."
    LOCAL = "A local minimum: at another delay within the bounds the cost is lower; start there, or use delay_profile."
    REFLECTED = (
        "The last step led to an unstable model, whose poles were mirrored: this is no minimum of the output-error "
        "cost; use fewer poles or another start, or closed-loop instruments for an unstable plant in a loop."
    )
    SINGULAR = (
        "The equations became singular: the data do not determine all parameters; use fewer poles or zeros, or an "
        "input that excites the system more."
    )
    DIVERGED = "The iterations diverged; use variant 'guarded', another svf_cutoff, or a start closer to the solution."

    @property
    def succeeded(self) -> bool:
        """Whether the estimate may be used as it stands."""
        return self in (Status.CONVERGED, Status.AT_BOUND, Status.RIDGE, Status.LEAST_SQUARES)
