"""Parser of pages: checks that elements are closed, and collects links, data and text."""

import json
import re
from html.parser import HTMLParser

VOID = ("meta", "br", "link", "img", "input", "hr")


class ParsedPage(HTMLParser):
    """Parser that checks the nesting of elements and collects what a browser would fetch."""

    def __init__(self, text):
        """Parse the text."""
        super().__init__()
        self.open, self.fetched, self.ids, self.targets, self.words, self.data = (
            [],
            [],
            [],
            [],
            [],
            [],
        )
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append((tag, dict(attributes).get("type")))
        for name, value in attributes:
            if name == "id":
                assert value not in self.ids
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "data", "poster") and not value.startswith(
                "data:"
            ):
                (self.targets if value.startswith("#") else self.fetched).append(value)
        assert tag not in ("iframe", "object")

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == ("script", "application/json"):
            self.data.append(json.loads(data))
        elif not self.open or self.open[-1][0] not in ("script", "style"):
            self.words.append(data)

    @property
    def text(self):
        """Visible text, in one line."""
        return " ".join(" ".join(self.words).split())


def check_self_contained(text):
    """Check that a page fetches nothing, and return it parsed."""
    parsed = ParsedPage(text)
    assert parsed.fetched == []
    assert {target[1:] for target in parsed.targets} <= set(parsed.ids)
    style = "".join(re.findall(r"<style>(.*?)</style>", text, re.DOTALL))
    assert re.findall(r"url\(|@import", style) == []
    assert "default-src 'none'" in text
    return parsed
