"""``ctid figure``: files, where they go, and what is refused."""

from xml.etree import ElementTree

import pytest

from ctid_cli.studies.catalogue import find_study


def test_files_go_to_the_folder_of_the_study(ctid, tmp_path):
    done = ctid("figure", "useful-redundancy/1", "2", "--out", tmp_path / "new")
    folder = tmp_path / "new" / "useful_redundancy_figures"
    assert done.stdout.splitlines() == [str(folder / "figure_1.svg"), str(folder / "figure_2.svg")]
    for file in folder.iterdir():
        assert ElementTree.parse(file).getroot().tag.endswith("svg")
    assert len(list(folder.iterdir())) == 2


def test_a_single_figure_goes_where_it_is_told(ctid, tmp_path):
    file = tmp_path / "some" / "cost.svg"
    assert ctid("figure", "1", "--file", file, "--out", tmp_path / "unused").stdout == f"{file}\n"
    assert not (tmp_path / "unused").exists()
    first = file.read_bytes()
    ctid("figure", "1", "--file", file)
    assert file.read_bytes() == first


def test_a_study_means_all_of_its_figures(ctid, tmp_path, monkeypatch):
    module = find_study("useful-redundancy").module("figures")
    for number in range(1, 8):
        monkeypatch.setattr(module, f"figure_{number}", lambda number=number: f"<svg>{number}</svg>".encode())
    done = ctid("figure", "useful-redundancy", "--out", tmp_path)
    files = [tmp_path / "useful_redundancy_figures" / f"figure_{k}.svg" for k in range(1, 8)]
    assert done.stdout.split() == [str(file) for file in files]
    assert [file.read_text() for file in files] == [f"<svg>{k}</svg>" for k in range(1, 8)]
    assert ctid("figure", "--out", tmp_path).stdout == done.stdout


@pytest.mark.parametrize("name", ["8", "useful-redundancy/8", "usefull-redundancy", "useful-redundancy/"])
def test_unknown_figures_are_refused_before_anything_is_drawn(ctid, tmp_path, name):
    done = ctid("figure", "1", name, "--out", tmp_path, code=2)
    assert done.stdout == ""
    assert done.stderr.startswith("ctid: ")
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_one_file_for_several_figures_is_refused(ctid, tmp_path):
    done = ctid("figure", "1", "2", "--file", tmp_path / "x.svg", code=2)
    assert done.stderr == "ctid: --file takes one figure, not 2; --out names the folder of several\n"


def test_a_file_that_cannot_be_written_is_a_storage_error(ctid, tmp_path):
    (tmp_path / "taken").write_text("")
    done = ctid("figure", "1", "--file", tmp_path / "taken" / "x.svg", code=6)
    assert "cannot be written" in done.stderr


def test_figures_of_the_additive_study_that_need_no_results(ctid, tmp_path):
    done = ctid("figure", "additive/2", "--out", tmp_path)
    file = tmp_path / "additive_figures" / "figure_2.svg"
    assert done.stdout == f"{file}\n"
    assert ElementTree.parse(file).getroot().tag.endswith("svg")


@pytest.mark.parametrize(
    ("name", "configs"),
    [
        ("additive/3", ["open_loop"]),
        ("additive/4", ["closed_loop"]),
    ],
)
def test_figures_of_results_say_what_to_run_first(ctid, tmp_path, name, configs):
    done = ctid("figure", "additive/2", name, "--out", tmp_path, code=2)
    assert done.stdout == ""
    command = " ".join(f"configs/additive/{config}.yaml" for config in configs)
    assert done.stderr == (
        f"ctid: there are no results in {tmp_path} to draw this from; run first: ctid run {command} --out {tmp_path}\n"
    )
    assert not list(tmp_path.iterdir())


def test_help_says_which_figures_need_results(ctid):
    text = " ".join(ctid("figure", "--help").stdout.split())
    assert "additive/3" in text
    assert "run first" in text
