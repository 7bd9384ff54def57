"""Sensitivities of the simulated output to all parameters, at the used samples of measured records."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.box import ANYWHERE, point_of
from ctid_cli.estimation.optimum.chain import Chain, block_diagonal, numerators
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.triangle import Columns, Delay, rows_of
from ctid_cli.estimation.parameter_layout import Layout


def sensitivities(problem: Problem, layout: Layout, theta: Array, delays: Sequence[float]) -> list[tuple[Array, Array]]:
    """Return the derivatives of the output by the parameters, and the output error, at the used samples of each record.

    Delays that are parameters equal those of theta. With integrators the last coefficients of a denominator are zero.
    """
    degrees = layout.degrees
    fractions, chain_rule = degrees.fractions_of(theta)
    total, count = chain_rule.shape
    places = [degrees.delay(k) for k in range(len(delays))]
    seconds = [given if place is None else theta[place] for given, place in zip(delays, places, strict=True)]
    arrangement = problem.arranged(degrees.poles - sum(problem.each_integrators))
    columns = Columns.of(arrangement, True, layout.initial_state, layout.trend)
    # Required combinations of the columns of the rows (states, inputs and others): first the derivatives by the
    # coefficients of all monic fractions.
    monic = np.zeros((columns.size, total))
    common, free = np.zeros((columns.size, layout.size + 1)), np.zeros((columns.size, total))
    forms, to_powers, column = list[tuple[Chain, Array, Array]](), np.zeros((arrangement.order,) * 2), 0
    for k, channel in enumerate(arrangement.channels):
        rows, powers, outputs, direct, first = [], list[Array](), [], np.zeros(len(channel.terms)), 0
        states, driven = monic[columns.z(k)], monic[columns.states(k)][channel.order :]
        alone = free[columns.free_states(columns.free.index(k))] if k in columns.free else np.zeros_like(free)
        for place, term in enumerate(channel.terms):
            (b, a), fractions = fractions[0], fractions[1:]
            order, m = a.size - 1, b.size - 1
            own, at = slice(first, first + order), slice(column, column + order)
            rows.append(_sections_of(a, term.integrators, problem))
            # From the states to p^(n-1)/A ... 1/A. With n zeros B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
            powers.append(np.asarray(np.linalg.inv(numerators(*rows[-1])), dtype=float))
            turned = powers[-1].T
            driven[own, at] = -turned
            alone[channel.order :][own, at] = -turned
            states[own, at.stop : at.stop + m + 1] = np.column_stack((-turned @ a[1:], turned))[:, order - m :]
            if m == order:
                monic[columns.u(k), at.stop] = 1.0
                direct[place], b = b[0], (b - b[0] * a)[1:]
            outputs.append(np.concatenate((np.zeros(order - b.size), b)) @ powers[-1])
            first, column = first + order, at.stop + m + 1
        form, output = Chain.of(rows), np.concatenate(outputs)
        forms.append((form, output, direct))
        to_powers[channel.states, channel.states] = block_diagonal(powers)
        if (delay := places[channel.input]) is not None:
            common[columns.z(k), delay] = -(output @ form.dynamics)
            common[columns.u(k), delay] = -(output @ form.gain)
        common[columns.z(k), -1], common[columns.u(k), -1] = -output, -direct.sum()
    common[:, :count] += (monic + free) @ chain_rule
    common[columns.y, -1] = 1.0
    result = []
    for record, (data, period) in enumerate(zip(problem.records, problem.periods, strict=True)):
        first = layout.first(record)
        own_values = theta[first : first + layout.own]
        n = arrangement.order
        state = (own_values[:n] if layout.initial_state else np.zeros(n)) @ to_powers
        each = zip(forms, arrangement.channels, strict=True)
        driving = [form.driving(output, direct, state[one.states]) for (form, output, direct), one in each]
        wanted = common.copy()
        for number, k in enumerate(columns.free):
            own = arrangement.channels[k].states
            wanted[columns.free_z(number), first + own.start : first + own.stop] = to_powers[own, own].T
        wanted[columns.powers, first + layout.own - len(layout.trend) : first + layout.own] = np.eye(len(layout.trend))
        wanted[:, -1] -= wanted[:, first : first + layout.own] @ own_values
        parts = rows_of(driving, columns, tuple(Delay(float(tau), -1) for tau in seconds), data, period)
        found = np.vstack([part.T @ wanted for part in parts])
        result.append((found[:, :-1], found[:, -1].copy()))
    return result


def _sections_of(denominator: Array, integrators: int, problem: Problem) -> tuple[Array, Array]:
    """Return the sections of a denominator, whose last coefficients are zero with integrators."""
    stable = np.roots(denominator[: denominator.size - integrators]).astype(complex)
    point = point_of(stable, 0.0, ANYWHERE)
    (sections,) = problem._replace(terms=(), integrators=integrators).rows(point.speed, point.damping)
    return sections
