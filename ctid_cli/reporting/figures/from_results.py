"""Figures that are drawn from the results of experiments, and what to run where these are missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import Results, experiments_in, out_option, read_results


@dataclass(frozen=True)
class FromResults:
    """A figure of results."""

    configs: Mapping[str, str]
    draw: Callable[..., bytes]

    def missing(self, out: Path) -> list[str]:
        """Specifications that were not run yet."""
        known = experiments_in(out)
        return [config for experiment, config in self.configs.items() if experiment not in known]

    def svg(self, out: Path) -> bytes:
        """Draw it."""
        if self.missing(out):
            raise not_run(self.missing(out), out)
        found: list[Results] = [read_results(out, experiment) for experiment in self.configs]
        return self.draw(*found)


def not_run(configs: list[str], out: Path) -> UsageError:
    """The error for a figure of experiments that were not run."""
    command = " ".join(["ctid run", *(f"configs/{config}" for config in configs)]) + out_option(out)
    return UsageError(f"there are no results in {out} to draw this from; run first: {command}")
