"""The part of YAML that calibration files use: nested keys, lists, numbers and words. No anchors, no block text.

Enough for what OpenCV, Kalibr and ROS write; anything else is refused rather than guessed.
"""

from __future__ import annotations

import re
from typing import Any

from rigkit.core.errors import InputError

__all__ = ["flow", "parse_yaml"]

KEY = re.compile(r"""^(?P<key>"[^"]*"|'[^']*'|[^\s:#\[\]{},&*!|>'"%@`-][^:#]*?)\s*:(?:\s+(?P<rest>.*))?$""")
TAG = re.compile(r"^!!?[\w./:-]*\s*")


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """Return the mapping in `text`; `name` is how errors call the file.

    Raises InputError where the text is not such a mapping.
    """
    lines = _logical_lines(text, name)
    if not lines:
        raise InputError(f"'{name}': empty; expected a calibration in YAML")
    value, rest = _block(lines, 0, lines[0][0], name)
    if rest != len(lines) or not isinstance(value, dict):
        number = lines[min(rest, len(lines) - 1)][2]
        raise InputError(f"'{name}', line {number}: not a plain YAML mapping; check the indentation")
    return value


def flow(values: Any) -> str:
    """Return numbers (possibly nested) as a YAML flow sequence that reads back to the same doubles."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return "[" + ", ".join(flow(v) for v in values) + "]"
    return repr(float(values)) if isinstance(values, float) else repr(values)


def _logical_lines(text: str, name: str) -> list[tuple[int, str, int]]:
    """Return (indent, content, line number) without comments; lists over several lines are joined."""
    out: list[tuple[int, str, int]] = []
    depth = 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = _without_comment(raw).rstrip()
        content = line.strip()
        if not content or content.startswith(("%YAML", "---", "...")):
            continue
        if "\t" in line[: len(line) - len(line.lstrip())]:
            raise InputError(f"'{name}', line {number}: a tab in the indentation; YAML takes spaces")
        if depth > 0:
            indent, before, first = out[-1]
            out[-1] = (indent, f"{before} {content}", first)
        else:
            out.append((len(line) - len(line.lstrip()), content, number))
        depth += content.count("[") + content.count("{") - content.count("]") - content.count("}")
    if depth != 0:
        raise InputError(f"'{name}': a list is not closed; is the file whole?")
    return out


def _without_comment(line: str) -> str:
    quote = ""
    for i, c in enumerate(line):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'":
            quote = c
        elif c == "#" and (i == 0 or line[i - 1].isspace()):
            return line[:i]
    return line


def _block(lines: list[tuple[int, str, int]], at: int, indent: int, name: str) -> tuple[Any, int]:
    """Return the mapping or list whose lines have `indent`, and the index of the first line after it."""
    if lines[at][1].startswith("- ") or lines[at][1] == "-":
        return _sequence(lines, at, indent, name)
    mapping: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent:
        _, content, number = lines[at]
        match = KEY.match(content)
        if match is None:
            raise InputError(f"'{name}', line {number}: expected 'key: value', got '{content[:40]}'")
        key, rest = match["key"].strip("\"'"), TAG.sub("", match["rest"] or "")
        if key in mapping:
            raise InputError(f"'{name}', line {number}: '{key}' is given twice")
        at += 1
        nested = at < len(lines) and (lines[at][0] > indent or (lines[at][0] == indent and lines[at][1][:1] == "-"))
        if not rest and nested:
            mapping[key], at = _block(lines, at, lines[at][0], name)
        else:
            mapping[key] = _value(rest, name, number)
    return mapping, at


def _sequence(lines: list[tuple[int, str, int]], at: int, indent: int, name: str) -> tuple[list[Any], int]:
    items: list[Any] = []
    while at < len(lines) and lines[at][0] == indent and lines[at][1].startswith("-"):
        _, content, number = lines[at]
        rest = content[1:].strip()
        at += 1
        if not rest and at < len(lines) and lines[at][0] > indent:
            item, at = _block(lines, at, lines[at][0], name)
        else:
            item = _value(rest, name, number)
        items.append(item)
    return items, at


def _value(text: str, name: str, number: int) -> Any:
    """Return a scalar or a flow sequence."""
    text = text.strip()
    if not text.startswith("["):
        return _scalar(text)
    stack: list[list[Any]] = [[]]
    for token in re.findall(r"""\[|\]|"[^"]*"|'[^']*'|[^\[\],\s][^\[\],]*""", text):
        if token == "[":
            stack.append([])
        elif token == "]" and len(stack) > 1:
            done = stack.pop()
            stack[-1].append(done)
        elif token == "]":
            raise InputError(f"'{name}', line {number}: a list is closed that was not opened")
        else:
            stack[-1].append(_scalar(token.strip()))
    if len(stack) != 1 or len(stack[0]) != 1:
        raise InputError(f"'{name}', line {number}: not a list: '{text[:40]}'")
    return stack[0][0]


def _scalar(text: str) -> Any:
    if text[:1] in "\"'" and text[-1:] == text[:1] and len(text) > 1:
        return text[1:-1]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    special = {"": None, "~": None, "null": None, ".nan": float("nan"), ".inf": float("inf"), "-.inf": float("-inf")}
    return special.get(text.lower(), text)
