"""An XML text of which single places are written anew and every other byte stays.

A robot's file holds more than a program reads: pictures, comments, its author's spacing. So what
changes is found by its position in the text, and nothing is written from a tree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.parsers import expat

from adapter.errors import ModelError

_OURS = "adapter export: "
_REMARK = re.compile(rb"\s*<!-- " + _OURS.encode() + rb".*?-->", re.DOTALL)
_TAG = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*>""")  # up to its `>`; one in a value is none
_ATTRIBUTE = re.compile(rb"""([^\s=/>"'<]+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass(eq=False)
class Element:
    """An element and where it stands, in bytes.

    Attributes:
        tag, attributes: as read; children: elements in it, in order.
        start: of its `<`; inside: after its start tag; close: of its end tag, None where it is
            written `<tag/>`; end: after all of it.
        parent: that it stands in, None for the top one.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    parent: Element | None
    inside: int = 0
    close: int | None = None
    end: int = 0
    children: list[Element] = field(default_factory=list)

    def child(self, tag: str) -> Element | None:
        """The first child of that tag."""
        return next((child for child in self.children if child.tag == tag), None)

    def walk(self) -> list[Element]:
        """It and all below, in the text's order."""
        return [self, *(found for child in self.children for found in child.walk())]


class XmlText:
    """The text, its elements, and what is to be written into it.

    Raises:
        ModelError: the text is not XML.
    """

    def __init__(self, text: str, file: str) -> None:
        self._bytes = text.encode("utf-8")
        self._edits: list[tuple[int, int, bytes]] = []
        self._newline = "\r\n" if b"\r\n" in self._bytes else "\n"
        self._open: list[Element] = []
        parser = expat.ParserCreate("utf-8")  # whatever it says of itself: this is what it is now
        parser.StartElementHandler = lambda tag, at: self._start(tag, at, parser.CurrentByteIndex)
        parser.EndElementHandler = lambda tag: self._end(parser.CurrentByteIndex)
        try:
            parser.Parse(self._bytes, True)
        except expat.ExpatError as error:
            raise ModelError(f"{file}: not XML ({error})") from None

    def _start(self, tag: str, attributes: dict[str, str], start: int) -> None:
        parent = self._open[-1] if self._open else None
        element = Element(tag, attributes, start, parent)
        whole = _TAG.match(self._bytes, start)
        element.inside = whole.end() if whole else start
        if parent is None:
            self.root = element
        else:
            parent.children.append(element)
        self._open.append(element)

    def _end(self, at: int) -> None:
        element = self._open.pop()
        element.end = element.inside
        if self._bytes[element.inside - 2 : element.inside] != b"/>":
            element.close, element.end = at, self._bytes.index(b">", at) + 1

    def set(self, element: Element, key: str, value: str) -> None:
        """Give an attribute a value, in its place or as the last one."""
        found = self._attribute(element, key)
        if found is not None:
            start, end = found.span(2)
            self._edits.append((start + 1, end - 1, value.encode()))
            return
        tail = 1 if element.close is not None else 2
        head = self._bytes[element.start : element.inside - tail].rstrip()
        at = element.start + len(head)
        self._edits.append((at, at, f' {key}="{value}"'.encode()))

    def drop(self, element: Element, key: str) -> None:
        """Take an attribute out, with the space before it."""
        found = self._attribute(element, key)
        if found is not None:
            before = self._bytes[: found.start()]
            self._edits.append((len(before.rstrip()), found.end(), b""))

    def replace(self, element: Element, text: str) -> None:
        """Write something else in its place."""
        self._edits.append((element.start, element.end, text.encode()))

    def _attribute(self, element: Element, key: str) -> re.Match[bytes] | None:
        tag_end = element.start + 1 + len(element.tag.encode())
        places = _ATTRIBUTE.finditer(self._bytes, tag_end, element.inside)
        return next((m for m in places if m.group(1) == key.encode()), None)

    def insert(self, element: Element, text: str) -> None:
        """Add a child (lines, each indented as it shall be against the first) after the others."""
        outer = self._indent(element) or ""
        inner: str | None = f"{outer}  "
        if element.children:
            inner = self._indent(element.children[0])
        lines = text.splitlines()
        new = "".join(x.strip() for x in lines)  # where all stands in one line
        if inner is not None:
            new = "".join(f"{self._newline}{inner}{line}" for line in lines)
        if element.children:
            at = end = element.children[-1].end
        elif element.close is None:
            head = self._bytes[element.start : element.inside - 2].rstrip()
            at, end = element.start + len(head), element.inside
            new = f">{new}{self._newline}{outer}</{element.tag}>"
        else:
            content = self._bytes[element.inside : element.close]
            at = end = element.inside + len(content.rstrip())
            if b"\n" not in content[len(content.rstrip()) :]:
                new += f"{self._newline}{outer}"
        self._edits.append((at, end, new.encode()))

    def remark(self, lines: Sequence[str]) -> None:
        """Put a comment first into the top element, in the place of an earlier one of ours.

        Without lines there is none. XML forbids two hyphens in a row in one.
        """
        at, start = _REMARK.match(self._bytes, self.root.inside), self.root.inside
        text = re.sub("-(?=-)", "- ", f"{self._newline}    ".join(lines))
        new = f"{self._newline}  <!-- {_OURS}{text} -->".encode() if lines else b""
        self._edits.append((start, at.end() if at else start, new))

    def _indent(self, element: Element) -> str | None:
        """What stands before an element in its line; None where that is more than space."""
        line = self._bytes[: element.start].rpartition(b"\n")[2]
        return line.decode() if not line.strip() else None

    def text(self) -> str:
        """The text with everything written in."""
        out = self._bytes
        for start, end, new in sorted(self._edits, key=lambda edit: edit[:2])[::-1]:
            out = out[:start] + new + out[end:]
        return out.decode("utf-8")
