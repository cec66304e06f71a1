"""YAML of calibration files: mappings, lists, numbers and words, read by PyYAML within limits.

Tags other than OpenCV's, aliases, duplicate keys and deep nesting are refused. Numbers are those of YAML 1.2 (1e-5 is
one, 1:30 is not).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Hashable
from typing import Any

from rigkit.core.errors import InputError

MAX_CHARACTERS = 1_000_000
"""A camchain has two thousand; OpenCV's samples write all corners of all views."""
MAX_DEPTH = 20
MAX_YAML_DIGITS = 40
"""Digits of an integer."""

NULL, BOOL, INT, FLOAT = (f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float"))
RESOLVED = (
    (NULL, re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    (BOOL, re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    (INT, re.compile(rf"^[-+]?[0-9]{{1,{MAX_YAML_DIGITS}}}$"), list("-+0123456789")),
    (
        FLOAT,
        re.compile(
            r"^(?:[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+.0123456789"),
    ),
)
"""Tag, pattern, and first characters: the core schema of YAML 1.2."""


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """Return the mapping in `text`; `name` is the file name for errors.

    Raises InputError for any other text, or one beyond the limits above.
    """
    import yaml

    if len(text) > MAX_CHARACTERS:
        raise InputError(f"'{name}': {len(text)} characters, more than {MAX_CHARACTERS}; leave the data of images out")
    # OpenCV's first line is no valid directive: that would be "%YAML 1.0".
    body = re.sub(r"\A\s*%YAML[^\n]*", "", text)
    try:
        value = yaml.load(body, _loader())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = "" if mark is None else f", line {mark.line + 1}"
        raise InputError(f"'{name}'{line}: {error.problem or error.context}; correct that line") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        words = str(error).splitlines()[0]
        raise InputError(f"'{name}': not readable as YAML ({words}); is the file whole?") from error
    if not isinstance(value, dict):
        raise InputError(f"'{name}': not a mapping of YAML; is it a calibration file, and whole?")
    return value


def flow(values: Any) -> str:
    """Return numbers (possibly nested) as a YAML flow sequence that reads back to the same doubles, also in YAML 1.1
    (PyYAML, Kalibr, ROS), where 1e-9 is a string and 1.0e-9 a number."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return "[" + ", ".join(flow(v) for v in values) + "]"
    if not isinstance(values, float):
        return repr(values)
    text = repr(float(values))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _float(text: str) -> float:
    """Return the number; YAML writes .inf and .nan."""
    bare = text.lower()
    return float(bare.replace(".", "") if bare.endswith(("inf", "nan")) else bare)


@functools.cache
def _loader() -> Any:
    """Return PyYAML's safe loader with the limits above; PyYAML is imported at the first call."""
    import yaml

    class Loader(yaml.SafeLoader):
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            if self.check_event(yaml.AliasEvent):
                raise yaml.composer.ComposerError(None, None, "aliases (*name) are not read", mark)
            if self.depth > MAX_DEPTH:
                raise yaml.composer.ComposerError(None, None, f"nested more than {MAX_DEPTH} deep", mark)
            self.depth += 1
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
            out: dict[Hashable, Any] = {}
            for key_node, value_node in node.value:
                key = key_node.value
                if not isinstance(key, str):
                    raise yaml.constructor.ConstructorError(None, None, "a key is no word", key_node.start_mark)
                if key in out:
                    words = f"'{key[:40]}' is given twice; leave one"
                    raise yaml.constructor.ConstructorError(None, None, words, key_node.start_mark)
                out[key] = self.construct_object(value_node, deep=True)
            return out

    def untagged(loader: Any, suffix: str, node: Any) -> Any:
        """Read a node with OpenCV's tag, such as !!opencv-matrix, as if it had none."""
        return loader.construct_mapping(node) if isinstance(node, yaml.MappingNode) else loader.construct_sequence(node)

    Loader.yaml_implicit_resolvers = {}
    for tag, pattern, first in RESOLVED:
        Loader.add_implicit_resolver(tag, pattern, first)
    Loader.yaml_constructors = {
        NULL: yaml.SafeLoader.construct_yaml_null,
        BOOL: yaml.SafeLoader.construct_yaml_bool,
        INT: lambda loader, node: int(node.value),
        FLOAT: lambda loader, node: _float(node.value),
        "tag:yaml.org,2002:str": yaml.SafeLoader.construct_yaml_str,
        "tag:yaml.org,2002:seq": lambda loader, node: loader.construct_sequence(node, deep=True),
        "tag:yaml.org,2002:map": lambda loader, node: loader.construct_mapping(node),
        None: yaml.SafeLoader.construct_undefined,
    }
    Loader.yaml_multi_constructors = {"tag:yaml.org,2002:opencv-": untagged}
    return Loader
