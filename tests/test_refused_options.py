"""What the parser refuses is told in one sentence, like every other mistake, with the option as it was typed."""

import re

import pytest

from colmap_sph.app import cli


def refused(capsys: pytest.CaptureFixture[str], line: str) -> str:
    """The one sentence with which a command line ends that holds a mistake."""
    assert cli.main(line.split()) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.startswith("error: ") and error.count("\n") == 1
    return error.removeprefix("error: ").rstrip("\n")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("run --modl sparse/0", "There is no option --modl (did you mean --model?)"),
        ("run -x", "There is no option -x"),
        ("run --until x", "There is no option --until"),
        ("run --fusion.inpt x", "There is no option --fusion.inpt (did you mean --fusion.input?)"),
        ("run --num_pairs x", "--num_pairs takes a whole number, not 'x'"),
        ("run --num-pairs=1e3", "--num-pairs takes a whole number, not '1e3'"),
        ("run --model --threads 2", "--model needs a value"),
        ("run --num-pairs", "--num-pairs needs a value"),
        ("run --stage foo", "--stage takes one of prepare, match, vote, confirm, not 'foo'"),
        ("run --vote.tolerance x", "--vote.tolerance takes a number, not 'x'"),
        ("run --depth.vote-tolerance x", "--depth.vote-tolerance takes a number, not 'x'"),
        ("run --matching.keep-blank 3", "--matching.keep-blank takes True or False, not '3'"),
        ("run --dry-run=True", "--dry-run takes no value"),
        ("run sparse/0 sparse/1", "'sparse/1' is one argument too many, or an option's name is missing before it"),
        (
            "run --model a b",
            "'b' is one argument too many, or an option's name is missing before it",
        ),
    ],
)
def test_options_of_run(line: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, line) == f"{sentence}; see colmap_sph run --help-all."


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("export", "Give a workspace"),
        ("export a b", "'b' is one argument too many, or an option's name is missing before it"),
        ("export dense --formats laz foo", "--formats takes one of las, .*, not 'foo'"),
        ("surface dense --cell abc", "--cell takes a number, not 'abc'"),
        ("surface dense --plane 1,2,3 4,5,6", "--plane needs 3 values"),
        ("surface dense --no-orthophoto=1", "--no-orthophoto takes no value"),
        ("mesh dense --method foo", "--method takes one of tsdf, poisson, not 'foo'"),
        ("evaluate", "Give --reference"),
        ("evaluate a.ply --reference b.ply --tau 1 x", "--tau takes a number, not 'x'"),
        ("evaluate a.ply --reference b.ply --register", "--register needs a value"),
        ("evaluate a.ply --reference b.ply --reference-shift 1 2", "--reference-shift needs 3 values"),
        ("demo --threads 1.5", "--threads takes a whole number, not '1.5'"),
        ("view", "Give a workspace"),
    ],
)
def test_options_of_other_commands(line: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.fullmatch(f"{sentence}; see colmap_sph {line.split()[0]} --help.", refused(capsys, line))


@pytest.mark.parametrize(("word", "guess"), [("expor", r" \(did you mean export\?\)"), ("foo", "")])
def test_a_command_that_there_is_not(word: str, guess: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.fullmatch(
        f"There is no command '{word}'{guess}; the commands are run, .*, and those of COLMAP.",
        refused(capsys, word),
    )


def test_no_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, "").startswith("Name a command: run, demo, ")


def test_what_only_the_parser_knows_is_told_without_its_box(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_sph.app.refusals._problem", lambda *_: None)
    told = refused(capsys, "run --stage foo")
    assert told.startswith("The command line is not understood: invalid choice 'foo' for argument '--stage'.")
    assert not set("╭╮╰╯│─").intersection(told)
