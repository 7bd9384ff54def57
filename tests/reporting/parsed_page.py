"""Parser of pages for tests."""

from collections import Counter
from html.parser import HTMLParser

VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """Content of a page; refuses tags that are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], Counter(), [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags[tag] += 1
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags[tag] += 1
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def alone(text):
    """Assert that a page runs nothing, loads nothing, and is small enough to be sent; return it parsed."""
    page = Page(text)
    assert not {"script", "link", "img", "iframe"} & {tag for tag, n in page.tags.items() if n}
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    places = [value for name, value in page.attributes if name in ("href", "xlink:href", "src", "action")]
    assert places
    assert all(value.startswith(("#", "data:image/png;base64,")) for value in places)
    names = Counter(value for name, value in page.attributes if name == "id")
    assert max(names.values()) == 1
    assert {value[1:] for value in places if value.startswith("#")} <= names.keys()
    assert "url(http" not in text
    assert len(text) < 2_000_000
    return page
