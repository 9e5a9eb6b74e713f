"""Help, colours and errors of the command line: examples that parse, advice that leads on."""

from __future__ import annotations

import functools
import json
import re
import shlex

import pytest
import tyro
from rich.table import Table

from muxjax.cli import COMMANDS, GROUPS, leaves, main
from muxjax.cli.output import complain, make_console, verdict
from muxjax.config import data_folder

EXAMPLE = re.compile(r"Example: (muxjax .*?)(?:\n\n|\n\s*(?:Args|Raises|Example)|\Z)", re.DOTALL)
# Commands that print no document: a server, and one whose output is JSON anyway.
WITHOUT_JSON = {("board",), ("config", "schema"), ("view",)}


def examples(call) -> list[list[str]]:
    """Words of every example in a docstring, a continued line as one."""
    return [shlex.split(" ".join(text.split())) for text in EXAMPLE.findall(call.__doc__ or "")]


def parsed(call, words: list[str]):
    """What the command would be called with."""

    @functools.wraps(call)
    def stub(*args, **kwargs):
        return args, kwargs

    return tyro.cli(stub, args=words, console_outputs=False)


@pytest.mark.parametrize("words", leaves(), ids=" ".join)
def test_every_command_has_examples_that_parse(words):
    call = leaves()[words]
    found = examples(call)
    assert found, f"muxjax {' '.join(words)} has no example"
    for example in found:
        assert example[: 1 + len(words)] == ["muxjax", *words]
        parsed(call, example[1 + len(words) :])


def test_an_example_that_does_not_parse_is_noticed():
    with pytest.raises(SystemExit):
        parsed(leaves()[("fk",)], ["sixty"])
    with pytest.raises(SystemExit):
        parsed(leaves()[("export",)], ["program.json"])  # --out is required


@pytest.mark.parametrize("group", GROUPS)
def test_groups_have_an_example_of_one_of_theirs(group):
    (example,) = examples(COMMANDS[group])
    assert example[:2] == ["muxjax", group]
    parsed(GROUPS[group][example[2]], example[3:])


@pytest.mark.parametrize("words", leaves(), ids=" ".join)
def test_options_are_explained_and_json_is_there(words):
    call = leaves()[words]
    names = list(call.__code__.co_varnames[: call.__code__.co_argcount])
    explained = set(re.findall(r"^        (\w+): \S", call.__doc__ or "", re.MULTILINE))
    assert set(names) <= explained
    assert ("json" in names) == (words not in WITHOUT_JSON)


@pytest.mark.parametrize("words", leaves(), ids=" ".join)
def test_help_that_lists_presets_lists_all_that_ship(words):
    shipped = {path.stem for path in (data_folder("configs") / "planners").glob("*.yaml")}
    for line in re.findall(
        r"^ +preset: (.* or a YAML file)", leaves()[words].__doc__, re.MULTILINE
    ):
        assert set(re.findall(r"[a-z-]+(?=,)", line)) == shipped


def test_method_and_planner_name_each_other():
    assert re.search(r"method: .*--planner", leaves()[("plan",)].__doc__)
    for command in ("run", "resume"):
        assert re.search(r"planner: .*--method", leaves()[(command,)].__doc__)


@pytest.fixture
def muxjax(capsys, monkeypatch, tmp_path):
    """Run a command; exit code, standard output and standard error."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        return int(stop.value.code or 0), *capsys.readouterr()

    return call


def test_the_first_help_has_examples_that_parse(muxjax):
    code, text, _ = muxjax("--help")
    assert code == 0
    head = text.split("subcommands")[0]
    found = [line for line in re.findall(r"Example: (muxjax .*)", head) if "--help" not in line]
    assert len(found) >= 2
    for line in found:
        _, command, *rest = shlex.split(line)
        parsed(COMMANDS[command], rest)
    for name in COMMANDS:
        assert re.search(rf"• {name}\b", text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fk", "1", "2", "3"), r"fk: muxarm has 3 segments; give 6 numbers, .*found 3"),
        (("plan", "--q-deg", "60", "0"), r"--q-deg: muxarm has 3 segments; give 6 numbers"),
        (
            ("plan", "--q-deg", "60", "0", "-25", "20", "0", "0"),
            r"--q-deg: number 3, the bending angle of segment 2, must be at least 0, found -25; "
            r"bend the other way: theta 25, phi \+ 180",
        ),
        (
            ("view", "--q-deg", "-25", "0", "0", "20", "0", "0"),
            r"--q-deg: number 1, the bending angle of segment 1, must be at least 0",
        ),
        (
            ("fk", "60", "0", "75", "nan", "40", "0"),
            r"fk: number 4, the azimuth of segment 2, must be finite, found nan",
        ),
        (
            ("plan", "--q-deg", "60", "0", "5", "-20", "0", "0", "--servos", "1", "1"),
            r"servos: servo 1 is named twice",
        ),
        (("urdf", "--q-deg", "60", "0"), r"--q-deg: muxarm has 3 segments; give 6 numbers"),
        (("figure", "fig6", "--q-deg", "1"), r"--q-deg: muxarm has 3 segments; give 6 numbers"),
        (("run", "nope.json"), r"nope\.json: cannot be read .*; muxjax plan --out writes programs"),
        (("resume", "nope.journal", "--bus", "x"), r"no such journal; muxjax run --journal writes"),
        (("statics", "posture"), r"give either --tension-n or --displacements-mm"),
    ],
)
def test_errors_say_what_to_do_next(muxjax, arguments, message):
    code, out, error = muxjax(*arguments)
    assert code == 2
    assert out == ""
    (line,) = error.splitlines()
    assert re.match(r"muxjax: ", line)
    assert re.search(message, line)
    words = " ".join(w for w in arguments[:2] if w in {*COMMANDS, "fig6", "posture"})
    # One piece of advice: the message's own, or where the examples are.
    assert line.endswith(f" (muxjax {words} --help has examples)") != ("; muxjax" in line)


def shown(console) -> str:
    table = Table("heading")
    table.add_row(verdict("FAIL", False))
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def test_colours_on_a_terminal_none_in_a_pipe_none_with_no_color(monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    assert "\x1b" not in shown(make_console())  # captured by pytest: no terminal
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    coloured = shown(make_console())
    assert re.search(r"\x1b\[[0-9;]*31m", coloured)  # red
    assert re.search(r"\x1b\[[0-9;]*36m", coloured)  # cyan headings
    monkeypatch.setenv("NO_COLOR", "1")
    plain = shown(make_console())
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", plain)
    assert "FAIL" in plain  # the word says it without its colour


def test_brackets_and_colons_are_text(capsys):
    complain("--out: [red]x[/red] :smile: must end in .csv", "try [mm]")
    assert capsys.readouterr().err == (
        "muxjax: --out: [red]x[/red] :smile: must end in .csv (try [mm])\n"
    )


@pytest.mark.filterwarnings("error")
def test_json_is_json_alone(muxjax):
    for theta in ("60", "90"):  # a tool that lies flat has no unique roll and yaw
        code, out, error = muxjax("fk", theta, "0", "0", "0", "0", "0", "--json")
        assert code == 0
        assert error == ""
        assert json.loads(out)["robot"] == "muxarm"
