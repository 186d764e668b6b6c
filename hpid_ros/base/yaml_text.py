"""Writes YAML that ROS, PyYAML and YAML 1.2 read back as the same values.

rcl reads more words without quotes as booleans and numbers than PyYAML does, which would write
``y``, ``n``, ``inf``, ``nan`` and ``1e5`` plainly (rcl_yaml_param_parser, ``src/parse.c``,
``get_value``). So only what can be nothing but a text stands without quotes.
"""

from __future__ import annotations

import re
import sys
from typing import Any

import yaml

from hpid_ros.base.errors import SettingError

_PLAIN = re.compile("[A-Za-z_/][A-Za-z0-9_/*.-]*")
_OTHERWISE = frozenset(
    ("y", "n", "yes", "no", "true", "false", "on", "off", "null", "inf", "infinity", "nan")
)
"""Words that some parser takes for something else, in whatever case."""


class _Writer(yaml.SafeDumper):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        """Write what occurs twice twice: rcl knows no aliases."""
        return True


class _WriterWithNul(_Writer):
    """For readers other than rcl, whose texts end at a NUL."""


def _text(writer: _Writer, text: str) -> yaml.ScalarNode:
    has_nul = "\0" in text and not isinstance(writer, _WriterWithNul)
    if has_nul or any("\ud800" <= character <= "\udfff" for character in text):
        raise SettingError(f"{text!r} cannot be written to a file: it is no text of Unicode")
    is_plain = _PLAIN.fullmatch(text) and text.lower() not in _OTHERWISE
    style = None if is_plain else "'" if text.isprintable() else '"'
    return writer.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Writer.add_representer(str, _text)
_WriterWithNul.add_representer(str, _text)


def dump_yaml(
    document: Any,
    *,
    flow: bool | None = False,
    width: float = sys.maxsize,
    may_have_nul: bool = False,
) -> str:
    """Return a document as YAML, its keys in their order.

    ``flow`` writes collections in one line each, None only those without others in them.
    """
    return yaml.dump(  # type: ignore[no-any-return]
        document,
        Dumper=_WriterWithNul if may_have_nul else _Writer,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=flow,
        width=width,
    )


def inline_yaml(value: Any) -> str:
    """Return a value as YAML within a line, also within a list or a mapping in braces."""
    return dump_yaml([value], flow=True)[1:-2]
