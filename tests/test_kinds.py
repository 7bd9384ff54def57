"""The registry of kinds contains every option class of the package, and nothing else."""

import dataclasses
import importlib
import inspect
import pkgutil

import ctid_cli
from ctid_cli.kinds import KINDS, classes


def test_every_class_with_a_kind_is_in_the_registry():
    found = set()
    for info in pkgutil.walk_packages(ctid_cli.__path__, "ctid_cli."):
        for member in vars(importlib.import_module(info.name)).values():
            own = inspect.isclass(member) and member.__module__ == info.name and dataclasses.is_dataclass(member)
            if own and isinstance(getattr(member, "kind", None), str):
                found.add(member)
    registered = {member for section in KINDS for member in classes(section).values()}
    assert registered <= found
    # Another class may have the same kind in another section.
    assert {member.kind for member in found} == {member.kind for member in registered}
    assert len(found) >= 25


def test_kinds_are_those_of_their_classes():
    for section in KINDS:
        assert [member.kind for member in classes(section).values()] == list(KINDS[section])
