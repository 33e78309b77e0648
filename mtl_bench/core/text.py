"""Text that anybody may have written, such as names and messages, for tables and pages."""

import re

BREAKS = re.compile(r"\s*[\x00-\x1f\x7f-\x9f\u2028\u2029]+\s*")
MARKUP = re.compile(r"([\\`*$~\[\]|]|(?<!\w)_|_(?!\w))")


def in_a_line(text: str) -> str:
    """Without line breaks and control characters."""
    return BREAKS.sub(" ", text).strip()


def in_markdown(text: str) -> str:
    """As it is read, in a line: no markup and no HTML of its own."""
    escaped = MARKUP.sub(r"\\\1", in_a_line(text))
    return re.sub(r"&(?=#?\w+;)", "&amp;", escaped).replace("<", "&lt;")
