"""Fields of structs in the API reference: here they are described by a comment beside each."""

from __future__ import annotations

import ast
import re
from typing import Any

import griffe


class CommentedFields(griffe.Extension):
    """Gives a class whose docstring lists no attributes those that have a comment in its body."""

    def on_class_members(self, *, node: Any, cls: griffe.Class, **_: Any) -> None:
        """Append an ``Attributes:`` section, which the Google parser then reads."""
        if not isinstance(node, ast.ClassDef) or cls.docstring is None:
            return
        if re.search(r"^\s*Attributes:", cls.docstring.value, re.MULTILINE):
            return
        source = cls.lines
        told = {}
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                comment = _comment(source, field, cls.lineno or 1)
                if comment and not field.target.id.startswith("_"):
                    told[field.target.id] = comment
        if told:
            lines = [f"    {name}: {comment}" for name, comment in told.items()]
            cls.docstring.value += "\n\nAttributes:\n" + "\n".join(lines)


def _comment(source: list[str], field: ast.AnnAssign, first: int) -> str:
    """The comment behind a field, and what follows it on lines of its own, further in."""
    at = (field.end_lineno or field.lineno) - first
    behind = source[at].encode()[field.end_col_offset or 0 :].decode()
    found = re.match(r"\s*#\s*(.*)", behind)
    if not found:
        return ""
    words = [found[1]]
    for line in source[at + 1 :]:
        more = re.match(r"\s+#\s*(.*)", line)
        if not more:
            break
        words.append(more[1])
    return _plain(" ".join(words))


def _plain(text: str) -> str:
    """Text that Markdown leaves as it is; what stands between backquotes is code anyway."""
    parts = re.split(r"(`+[^`]*`+)", text)
    parts[::2] = [re.sub(r"([*_\[\]<])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
