"""The settings reference, and the guide in configs/README.md."""

from __future__ import annotations

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import preset_names, sections
from tools.docs import SETTINGS_REFERENCE, settings_reference


def test_the_committed_settings_reference_is_up_to_date():
    assert SETTINGS_REFERENCE.read_text(encoding="utf-8") == settings_reference(), "run python -m tools.docs"


def test_every_setting_is_in_the_reference_and_every_preset_in_the_guide():
    text, guide = settings_reference(), SETTINGS_REFERENCE.with_name("README.md").read_text(encoding="utf-8")
    keys = [f"{section}.{name}" for section, kind in sections().items() for name in settings_of(kind)]
    assert [key for key in keys if f"\n`{key}` | " not in text] == []
    assert [name for name in preset_names() if f"| `{name}` |" not in guide] == []
    assert len(guide.splitlines()) <= 300
