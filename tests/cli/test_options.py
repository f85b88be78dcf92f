"""Parsers of options: whole numbers, resolutions, shards; messages in one line."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.cli.main import main
from synpick_warp.cli.options import MAX_LINE, one_line, parse_resolution, parse_shard
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import ConfigError
from tests.builders import mistake
from tests.harness.fuzz import fuzz_examples

WRONG = ["1.6", "2.0", "1e3", "0x10", "0b1", "1_000", " 7", "7 ", "٣", "", "many", "9" * 5000, "nan", "--7", "1\n2"]
PLACES = [
    ("--worlds", "bake --out gone/set --device cpu"),
    ("--episodes", "bake --out gone/set --device cpu"),
    ("--seed", "bake --out gone/set --device cpu"),
    ("--writers", "bake --out gone/set --device cpu"),
    ("--worlds", "doctor"),
    ("--views", "preview gone"),
    ("--episode", "explain gone"),
    ("--attempt", "explain gone --episode 0"),
]


@pytest.mark.parametrize("text", WRONG)
@pytest.mark.parametrize(("option", "command"), PLACES)
def test_integer_options_take_decimal_digits_only(option, command, text):
    """Fault 7: `--worlds 1.6 --episodes 2.6 --seed 7.6` were rounded."""
    line = mistake(*command.split(), f"{option}={text}")
    assert line.startswith(f'{option} is "')
    assert line.endswith("allowed: a whole number in decimal digits, such as 8")


@pytest.mark.parametrize(
    ("text", "said"), [("-5", "bake.worlds is -5"), ("9" * 30, "bake.worlds is 9999999999"), ("65537", "bake.worlds is 65537")]
)
def test_whole_numbers_out_of_range_are_refused_by_their_setting(text, said):
    assert mistake("bake", "--out=gone/set", "--device=cpu", f"--worlds={text}").startswith(said)


SMOKE = load_config("smoke", {})
TEXT = st.text(st.sampled_from("0123456789xX/.-+e_ ²٣\n")) | st.text(max_size=20)


@settings(max_examples=fuzz_examples(100))
@given(text=TEXT)
def test_any_text_is_a_resolution_or_a_shard_or_one_line(text):
    for parse in (parse_resolution, lambda shard: DataLayout.of(SMOKE).plan_shard((), parse_shard(shard), "--shard")):
        message = "accepted"
        try:
            parse(text)
        except ConfigError as error:
            message = str(error)
        assert message.isprintable()


@settings(max_examples=fuzz_examples(100))
@given(text=st.text(st.characters()))
def test_any_message_is_one_printable_line(text):
    assert one_line(text).isprintable()
    assert len(one_line(text * 100)) <= MAX_LINE


WORDS = st.sampled_from(["bake", "config", "verify", "merge", "preview", "explain", "--out", "gone", "--set", "--config", "--help", "--"])


@settings(max_examples=fuzz_examples(50))
@given(arguments=st.lists(WORDS | st.text(st.characters(exclude_characters="\0"), max_size=6), max_size=6))
def test_any_command_line_ends_with_an_exit_code(tmp_path_factory, arguments):
    with contextlib.chdir(tmp_path_factory.mktemp("empty")), pytest.MonkeyPatch.context() as patch:
        patch.setattr("synpick_warp.cli.main._bake", lambda *_: 0)
        assert main(arguments) in (0, 1, 2)


def test_terminal_sequences_in_names_are_escaped():
    assert r"there is no file \x1b[2Jgone.toml" in mistake("config", "--config", "\x1b[2Jgone.toml")
