"""Requirements on error messages, for `fuzz.py`: they must name the file or option, and what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePath

VERBS = (
    "add|ask|calibrate|change|check|choose|compare|convert|copy|correct|count|create|describe|detect|export|get|give|increase|"
    "install|keep|leave|list|lower|make|mark|match|measure|extract|move|name|pip|put|raise|remove|rename|repeat|run|save|see|select|"
    "set|shorten|show|split|start|take|turn|update|use|wait|write|look|print|restore|say|send|decide|rectify|recalibrate|another"
)
REMEDY = re.compile(
    # What to do, after a break of the sentence, ...
    rf"(?:[;:,.(]|\band|\bor|\bthen|\binstead) (?:please )?(?:{VERBS})\b"
    # ... or what would be right instead.
    r"|\b(?:known|there are|there is only|another name|another folder|expected|must|needs?|needed|should|did you mean|"
    r"is it|is the file|only|"
    r"at least|at most)\b|--[a-z]|\bpip install\b"
)
"""An imperative, or what was expected."""
USAGE = re.compile(r"^usage: ")


def fault_of_message(message: str, file: str | None, words: Sequence[str]) -> str | None:
    """Return what the message lacks: the name of the damaged `file`, or, without one, any of the command's `words` or
    an option; and what to do. None where it lacks nothing."""
    if file is not None and file not in message:
        return f"message does not name the file: {message[:300]}"
    if file is None and not _mentions(message, words):
        return f"message names nothing of the command: {message[:300]}"
    if not REMEDY.search(message):
        return f"message does not say what to do: {message[:300]}"
    return None


def _mentions(message: str, words: Sequence[str]) -> bool:
    """Return whether the message names a word of the command (shown with escapes, or cut), or an option."""
    if re.search(r"--[a-z]|(?<!\w)-[a-z]\b", message):
        return True
    # Pairs and cameras are called after their files.
    stems = [f"'{stem}'" for stem in (PurePath(word).stem for word in words) if stem]
    shown = [name for word in words for name in (word, ascii(word)[1:-1], PurePath(word).name) if name]
    empty = ["''"] if "" in words else []
    return any(name[:40] in message for name in (*stems, *shown, *empty))
