"""Docstrings as Markdown: examples as code, an argument to a line, "<name>" as text."""

import re

import griffe

EXAMPLE = re.compile(r"(?:^[ ]*>>> .*\n?(?:^[ ]*\S.*\n?)*)+", re.MULTILINE)
ARGUMENT = re.compile(r"(?<=\S)\n(?=\*{0,2}[a-z_]\w*(?:, \*{0,2}\w+)*: )")


def legible(docstring: str) -> str:
    """What a page shows of a docstring: a line that begins with "name:" stays a line, others flow."""
    out, end = [], 0
    for found in EXAMPLE.finditer(docstring):
        out += [_text(docstring[end : found.start()]), f"\n```pycon\n{found[0].strip()}\n```\n"]
        end = found.end()
    return "".join([*out, _text(docstring[end:])])


def _text(words: str) -> str:
    parts = re.split(r"(`[^`\n]*`|^ {4,}.*$)", words, flags=re.MULTILINE)  # code and formulas stay as they are
    words = "".join(part if k % 2 else re.sub(r"<(?=\w)", "&lt;", part) for k, part in enumerate(parts))
    words = (
        re.sub(r"(?<=\w)\*(?=\w)|(?<= )\*(?= )|(?<=[\w\]])_(?=[\w\[])", r"\\\g<0>", words)
        if "`" not in words
        else words
    )
    return ARGUMENT.sub("  \n", words)


class Docstrings(griffe.Extension):
    """Makes every docstring legible as it is read."""

    def on_object(self, *, obj, **_) -> None:
        if obj.docstring:
            obj.docstring.value = legible(obj.docstring.value)
