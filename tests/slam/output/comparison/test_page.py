# SPDX-License-Identifier: Apache-2.0
from html.parser import HTMLParser

from slam.output.comparison.page import as_page
from slam.output.comparison.tables import Table

TABLE = Table(
    "<b>&", ("", "m"), (("a b", "0.01"), ("<i>", "-")), (("note", "1 < 2\x1b[1m"),), texts=1
)


class Read(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.links, self.texts = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if tag == "a" and name == "href"]

    def handle_data(self, data):
        self.texts.append(data)


def test_a_page_shows_what_stands_in_the_table_and_leads_where_it_is_told():
    page = Read()
    page.feed(as_page(TABLE, {"a b": "a b/report.html"}))
    assert page.links == ["a%20b/report.html"]
    assert not {"b", "i", "script"} & set(page.tags)
    assert page.tags.count("tr") == 3
    assert {"<b>&", "a b", "0.01", "<i>", "1 < 2\\x1b[1m"} <= set(page.texts)
