"""Sentences on each choice, with its criterion and that of the runner-up."""

from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.identification import Options
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.identification.choice import MOST_POLES, Candidate, Given, Ranking, Searched
from ctid_cli.inference.criteria import DECISIVE, OWN_PENALTY, PENALTY
from ctid_cli.signals.treatment import Holds, InitialState, InputBefore, Offset
from ctid_cli.text import count, listed

#: Sentence if the beginning of a record is not used.
STATE_OF_PART = (
    "State before the record: estimated (--initial-state estimate); the choice is made on a part of this long record."
)


#: Sentence if no integrator is tried.
NO_INTEGRATOR = (
    "Integrators: not tried, as the input changes at the beginning only, where the response of an integrator is that "
    "of a drift (--integrators 1 --offset none tries one)."
)


def spelled(options: Options) -> str:
    """Return a structure in words: poles, zeros and integrators, for each submodel if there are several."""
    if not isinstance(options, MeasuredSubmodels | AdditiveOutputError) or not options.factored:
        zeros = count(options.zeros, "zero") if options.zeros else "no zero"
        own = [one for one in getattr(options, "inputs", None) or () if one.zeros is not None]
        if own:
            zeros = f"numerators of degree {listed(f'{one.zeros} ({one.name})' for one in own)}"
        return f"{count(options.poles, 'pole')}, {zeros}{_integrators(getattr(options, 'integrators', 0))}"
    terms = options.terms
    parts = ", ".join(f"{term.poles}/{term.zeros}{_integrators(term.integrators)}" for term in terms)
    what = f"sum of {len(terms)} submodels" if len(terms) > 1 else "one submodel"
    return f"{what} with poles/zeros {parts}"


def _integrators(number: int) -> str:
    return f" and {count(number, 'integrator')}" if number else ""


def outlying(number: int) -> str:
    """Return the number of outliers in words."""
    return "1 output sample is an outlier" if number == 1 else f"{number} output samples are outliers"


def of_outliers(number: int) -> str:
    """Describe the loss chosen for outliers."""
    return f"Loss: tukey (--loss), as {outlying(number)}; all else is chosen without {'it' if number == 1 else 'them'}."


def of_assumed(options: Searched, given: Given, quiet: bool) -> str:
    """State the only state before the record that was left to compare, and why."""
    if options.initial_state == "estimate":
        why = "the output error from rest is more than twice as large"
    elif given.input_before is not None:
        why = "the input before the record is given"
    elif quiet:
        why = "the output is constant until the input changes"
    else:
        why = "this is assumed, as the input does not change enough after the longest delay to estimate a state"
    return f"State before the record: {_state(options)}; {why}."


def of_contradiction(hold: Holds, state: InitialState, before: InputBefore, offset: Offset) -> str:
    """State that another treatment is better with the final structure, and why it was not taken."""
    level = "" if state != "rest" else f" --input-before {'first' if before == 'first' else f'{before or 0:g}'}"
    return (
        f"With this structure --initial-state {state}{level} --offset {offset} --hold "
        f"{hold if isinstance(hold, str) else ' --hold '.join(hold)} has a lower criterion; it was not "
        "taken, since structures fitted with it lead to another structure, with which this treatment is better."
    )


def of_state(taken: Candidate, other: Candidate, likely: bool) -> str:
    """Describe the state, and by how much it is better than the other."""
    if not likely:
        return (
            "State before the record: estimated, as the first samples are not those of a system at rest "
            "(--initial-state estimate)."
        )
    fall = f"{_beside(taken, other)} than if it is {_state(other.options)}"
    if taken.criterion > other.criterion:
        fall += ", which is not decisive: a pole slower than the record is as flexible as a drift"
    return f"State before the record: {_state(taken.options)}; {fall}."


def _state(options: Searched) -> str:
    if options.initial_state != "rest":
        return "estimated (--initial-state estimate)"
    before = options.input_before
    level, typed = ("its first value", "first") if before == "first" else (f"{before or 0:g}",) * 2
    return f"at rest with the input at {level} (--initial-state rest, --input-before {typed})"


def of_setting(models: Ranking, name: str) -> str:
    """Describe the offset or the hold."""
    other = models.runner_up(name)
    fall = "nothing else could be tried"
    if other is not None:
        fall = f"{_beside(models.best, other)} than with the runner-up, {other.value(name)}"
    return f"{name.capitalize()}: {models.best.value(name)} (--{name}); {fall}."


def of_grid(
    ranking: Ranking, taken: Candidate, few: bool, delays: tuple[float, float], given: Given, time_unit: str
) -> list[str]:
    """Describe the structure and the range of the delay."""
    best, found = ranking.best, list[str]()
    others = [each for each in ranking.candidates if each.fit is not taken.fit and each.is_proper]
    lower = f"The criterion of {spelled(best.options)} is {shown(taken.criterion - best.criterion)} lower"
    if others and taken.fit is best.fit:
        runner = f"{_beside(taken, others[0])} than with the runner-up, {spelled(others[0].options)}"
        found.append(f"Structure: {spelled(taken.options)}; {runner}.")
    elif others and few:
        found.append(
            f"Structure: {spelled(taken.options)}. {lower}; as the input changes only a few times, that with the noise "
            f"model of each structure decides, each parameter counted {OWN_PENALTY:g} times."
        )
    elif others and taken.held_back is not None and best.held_back is not None:
        fits = f"{taken.held_back.percent:.1f} and {best.held_back.percent:.1f} %"
        found.append(
            f"Structure: {spelled(taken.options)}. {lower}, but its errors of held-back blocks are not significantly "
            f"smaller: their fits are {fits}."
        )
    found += _of_integrators(ranking, taken)
    if not isinstance(given.poles, int | tuple) and given.modes is None and best.options.order >= MOST_POLES:
        found.append(
            f"Structures with more than {MOST_POLES} poles were not tried (--poles 1:12 tries more); ctid frf shows "
            "whether the record has more lightly damped modes."
        )
    return found + of_range(delays, given, time_unit)


def _of_integrators(ranking: Ranking, taken: Candidate) -> list[str]:
    """Say that a structure with an integrator fits as well as one without, or the other way round."""
    number, limit = taken.options.integrators, taken.criterion + DECISIVE
    other = next((each for each in ranking.candidates if each.is_proper and each.options.integrators != number), None)
    if other is None or other.criterion > limit or isinstance(taken.options, AdditiveOutputError):
        return []
    what = "A slow pole instead of the integrator" if number else "An integrator instead of a slow pole"
    return [
        f"{what} fits as well: the criterion of {spelled(other.options)} is {_side(other, taken)} "
        f"(--integrators {other.options.integrators})."
    ]


def of_range(delays: tuple[float, float], given: Given, time_unit: str) -> list[str]:
    """Describe the range of the delay if it was chosen."""
    if given.delay_bounds is not None or given.delays_of_inputs:
        return []
    return [f"Delay: searched from 0 to {delays[1]:g} {time_unit} (--delay)."]


def of_criterion(ranking: Ranking) -> str:
    """Describe the criterion."""
    order = ranking.noise.order
    noise = f"one autoregressive noise model of order {order}" if order else "white noise"
    return f"Criterion: BIC of the innovations with {noise} for all, each parameter counted {PENALTY:g} times."


def _beside(one: Candidate, other: Candidate) -> str:
    """Compare the criterion of a candidate with that of another one."""
    return f"the criterion is {_side(one, other)}"


def _side(one: Candidate, other: Candidate) -> str:
    """Return by how much the criterion of a candidate is lower, or higher, than that of another one."""
    fall = other.criterion - one.criterion
    return f"{shown(abs(fall))} {'lower' if fall >= 0.0 else 'higher'}"


def shown(fall: float) -> str:
    """Return a difference of criteria with three digits."""
    return f"{fall:.0f}" if fall >= 100.0 else f"{fall:.3g}"
