"""The arguments of every public function, method and class are documented, and no other names."""

import enum
import importlib
import inspect
import pkgutil
import re
import sys
import typing

import pytest

import ctid_cli
from ctid_cli.kinds import KINDS, classes
from ctid_cli.models.controller import ContinuousPid, Relay
from ctid_cli.models.transfer_function import ContinuousModel
from ctid_cli.signals.noise import Noise
from ctid_cli.signals.sampling import InstantsFile, ListedInstants
from ctid_cli.signals.sinusoids import Piece, SumOfSinusoids, Tone
from ctid_cli.simulation.dataset import MeasuredSource
from ctid_cli.specification.sections import Section
from ctid_cli.specification.spec import Spec


def members_of(name, member):
    """Yield a callable and, for a class, its public methods, by name, except inherited ones."""
    yield name, member
    if inspect.isclass(member):
        for method_name, method in vars(member).items():
            inherited = any(method_name in vars(base) for base in member.__mro__[1:])
            if not method_name.startswith("_") and not inherited and callable(getattr(member, method_name)):
                plain = inspect.unwrap(getattr(method, "__func__", method))
                # Methods that a library adds to the class, such as pydantic's, are documented there.
                if inspect.isfunction(plain) and plain.__module__ == member.__module__:
                    yield f"{name}.{method_name}", plain


def public_callables():
    """Yield the exports of `ctid_cli`, and every class with options of a specification."""
    for name in ctid_cli.__all__:
        member = getattr(ctid_cli, name)
        if callable(member):
            yield from members_of(name, member)
    for section in KINDS:
        for kind, member in classes(section).items():
            if member.__name__ not in ctid_cli.__all__:
                yield kind, member
    for contract in (ContinuousModel, Noise):
        yield from members_of(f"{contract.__module__}.{contract.__name__}", contract)
    without_kind = (ContinuousPid, InstantsFile, ListedInstants, MeasuredSource, Piece, Relay, SumOfSinusoids, Tone)
    for member in (*without_kind, *written_sections()):
        yield member.__name__, member


def written_sections(base=Section):
    """Yield the sections of a specification written as classes, not made from option dataclasses."""
    for member in base.__subclasses__():
        if vars(sys.modules[member.__module__]).get(member.__name__) is member and not member.__name__.startswith("_"):
            yield member
            yield from written_sections(member)


def internal_docstrings():
    """Yield the docstring of every other function, method and class of the package."""
    public = {id(inspect.unwrap(member)) for member in CALLABLES.values()}
    for info in pkgutil.walk_packages(ctid_cli.__path__, "ctid_cli."):
        module = importlib.import_module(info.name)
        for name, member in vars(module).items():
            if getattr(member, "__module__", None) == info.name and callable(member):
                for full, found in members_of(f"{info.name}.{name}", inspect.unwrap(member)):
                    if id(found) not in public and found.__doc__:
                        yield full, found.__doc__


def documented(text):
    """Return the names in the Parameters section: the lines ``name : type`` or ``one, two : type``."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\S[^\n]*\n-{3,}$|\Z)", text, re.DOTALL | re.MULTILINE)
    entries = re.findall(r"^(\S[^:\n]*?)(?: : .*)?$", section.group(1) if section else "", re.MULTILINE)
    return [name.strip().lstrip("*") for entry in entries for name in entry.split(",")]


def described_in_place(annotation):
    """Return whether the annotation contains the text, as for command line options and specification fields."""
    metadata = typing.get_args(annotation)[1:] if typing.get_origin(annotation) is typing.Annotated else ()
    return any(getattr(item, "help", None) or getattr(item, "description", None) for item in metadata)


def expected(member):
    if hasattr(member, "model_fields"):
        return [name for name in member.model_fields if name in inspect.get_annotations(member)]
    if inspect.isclass(member) and (
        issubclass(member, enum.Enum)
        or getattr(member, "_is_protocol", False)
        or not inspect.isfunction(member.__init__)
    ):
        return []
    hints = {}
    if inspect.isfunction(member) and any("Annotated" in str(hint) for hint in member.__annotations__.values()):
        hints = typing.get_type_hints(member, include_extras=True)
    names = [name for name in inspect.signature(member).parameters if name not in ("self", "cls")]
    return [name for name in names if not described_in_place(hints.get(name))]


CALLABLES = dict(public_callables())


@pytest.mark.parametrize("name", CALLABLES)
def test_docstring_names_exactly_the_arguments(name):
    text = inspect.getdoc(CALLABLES[name]) or ""
    assert text, f"{name} has no docstring"
    if "options are those of :class:`" in text:
        # Options shared by several estimators are documented once, in their bases.
        shared = {option for base in CALLABLES[name].__mro__ for option in documented(inspect.getdoc(base) or "")}
        assert shared >= set(expected(CALLABLES[name]))
        assert set(documented(text)) <= set(expected(CALLABLES[name]))
    else:
        assert sorted(documented(text)) == sorted(expected(CALLABLES[name]))


def test_the_check_sees_what_is_missing_and_what_is_too_much():
    def function(one, two, *rest):
        """Summary.

        Parameters
        ----------
        one, *rest : int
            Text: with a colon.
        three : {"a", "b"}, default "a"
            Text.

        Returns
        -------
        four : int
            Text.
        """

    assert documented(inspect.getdoc(function)) == ["one", "rest", "three"]
    assert expected(function) == ["one", "two", "rest"]
    assert {"Prbs", "Excitation.generate", "Record.from_arrays", Spec.__name__} <= CALLABLES.keys()


def test_the_public_surface_is_small_and_shown():
    assert len(ctid_cli.__all__) <= 96
    assert set(ctid_cli.__all__) <= set(dir(ctid_cli))


def test_internal_docstrings_do_not_repeat_signatures():
    sections = re.compile(r"^ *(Parameters|Returns|Yields|Raises|Attributes)\n *-{3,}", re.MULTILINE)
    bases = {base.__qualname__ for member in CALLABLES.values() for base in getattr(member, "__mro__", ())}
    found = {name: text for name, text in internal_docstrings() if name.rpartition(".")[2] not in bases}
    assert len(found) > 500
    assert [name for name, text in found.items() if sections.search(text)] == []
