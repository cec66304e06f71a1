"""Files of cv2.FileStorage in YAML, XML or JSON.

OpenCV's calibration sample writes XML by default, with the keys Camera_Matrix, Distortion_Coefficients, image_Width and
image_Height before OpenCV 4.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import InputError
from rigkit.interop.yaml_text import MAX_CHARACTERS, MAX_DEPTH, parse_yaml

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

STORAGE = re.compile(r'!!opencv-matrix|<opencv_storage>|"type_id"\s*:\s*"opencv-matrix"|\A%YAML')
"""Pattern in such files."""
XML_START = re.compile(r"\A\s*<")
ENTITY = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
XML_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\.(?:inf|nan)", re.IGNORECASE)


def parse_storage(text: str, name: str) -> dict[str, Any]:
    """Return the content of a file, with each key also in lower case; `name` is the file name for errors.

    Matrices are mappings with `rows`, `cols` and `data`. Raises InputError for any other text.
    """
    data = _parse_xml(text, name) if XML_START.match(text) else parse_yaml(text, name)
    return {**{key.lower(): value for key, value in data.items()}, **data}


def _parse_xml(text: str, name: str) -> dict[str, Any]:
    from xml.etree import ElementTree

    if len(text) > MAX_CHARACTERS:
        raise InputError(f"'{name}': {len(text)} characters, more than {MAX_CHARACTERS}; leave the data of images out")
    if ENTITY.search(text):
        raise InputError(f"'{name}': XML with entities, which OpenCV does not write; is it a calibration file?")
    try:
        # The text is decoded already: the encoding in its first line must be ignored.
        root = ElementTree.fromstring(re.sub(r"\A\s*<\?[^>]*\?>", "", text))
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"'{name}': not readable as XML ({error}); is the file whole?") from error
    value = _value(root, name, 0)
    if root.tag != "opencv_storage" or not isinstance(value, dict):
        raise InputError(f"'{name}': XML, but none of OpenCV's; is it a calibration file?")
    return value


def _value(element: Element, name: str, depth: int) -> Any:
    """Return an element as the YAML reader does: a mapping, a list, a number or words."""
    if depth > MAX_DEPTH:
        raise InputError(f"'{name}': nested more than {MAX_DEPTH} deep; is it a calibration file?")
    inside = list(element)
    if not inside:
        words = (element.text or "").split()
        values = [_number(word) for word in words]
        if element.tag == "data" or (len(values) > 1 and not any(isinstance(v, str) for v in values)):
            return values
        return values[0] if len(values) == 1 else " ".join(words)
    if all(one.tag == "_" for one in inside):
        return [_value(one, name, depth + 1) for one in inside]
    out: dict[str, Any] = {}
    for one in inside:
        if one.tag in out:
            raise InputError(f"'{name}': '{one.tag[:40]}' is given twice; leave one")
        out[one.tag] = _value(one, name, depth + 1)
    return out


def _number(word: str) -> float | int | str:
    if not XML_NUMBER.fullmatch(word):
        return word
    if word.lstrip("+-").isdigit():
        return int(word) if len(word) < 40 else float(word)
    return float(word.replace(".", "") if word.lower().endswith(("inf", "nan")) else word)
