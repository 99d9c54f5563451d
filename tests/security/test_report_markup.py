"""Nothing that a run folder holds becomes markup of its report."""

import json
import re
from html.parser import HTMLParser

import pytest
from hostile_runs import MARKUP, places, with_markup, write_hostile_run

from dudmap.app.viewing.report import Html, html, joined, script_source, write_report
from dudmap.errors import DudmapError
from run_folders import write_run


class Harm(HTMLParser):
    """Counts scripts that run, and looks for handlers of events."""

    def __init__(self, page):
        super().__init__()
        self.scripts, self.handlers, self._in_script = [], [], False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self._in_script = tag == "script" and "type" not in dict(attrs)
        if self._in_script:
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._in_script = False

    def handle_data(self, data):
        if self._in_script:
            self.scripts[-1] += data


def checked(path):
    """The page of a report that runs the two scripts of dudmap and no more."""
    page = path.read_text(encoding="utf-8")
    harm = Harm(page)
    assert harm.handlers == []
    assert len(harm.scripts) == 2
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1].replace("&#x27;", "'")
    assert f"script-src {' '.join(map(script_source, harm.scripts))};" in policy
    assert "default-src 'none'" in policy
    return page


def test_markup_in_each_text_and_number_of_metrics_json(tmp_path, monkeypatch):
    monkeypatch.setattr("dudmap.app.viewing.report.plots", lambda run: {})  # no metric is part of a plot
    folder = write_run(tmp_path / "run")
    whole = json.loads((folder / "metrics.json").read_text())
    counts = {"skipped_similar": 1, "blind": 1, "uncertain": 1, "dropped": 1, "maps": 1}
    shown, refusals = 0, []
    for at in places(whole | counts):
        (folder / "metrics.json").write_text(json.dumps(with_markup(whole | counts, at)))
        try:
            page = checked(write_report(folder))
        except DudmapError as error:
            refusals.append(str(error))
        else:
            shown += "&quot;&gt;&lt;img src=x" in page
    assert shown > 20
    assert all("damaged" in refusal for refusal in refusals)


def test_markup_in_all_that_is_shown_at_once(tmp_path):
    page = checked(write_report(write_hostile_run(tmp_path / "run")))
    assert page.count("&lt;img src=x onerror=") > 10
    assert "<img src=x" not in page


@pytest.mark.parametrize("name", ["movers.jsonl", "timings.csv", "trajectory.txt"])
def test_markup_in_the_other_files(name, tmp_path):
    folder = write_run(tmp_path / "run")
    text = (folder / name).read_text()
    refusals = []
    numbers = list(re.finditer(r"[\d.]+|\w+", text))
    for match in numbers[:: max(1, len(numbers) // 10)]:
        (folder / name).write_text(text[: match.start()] + MARKUP.replace('"', "'") + text[match.end() :])
        try:
            checked(write_report(folder))
        except DudmapError as error:
            refusals.append(str(error))
    assert all(name in refusal or "damaged" in refusal for refusal in refusals)


def test_what_is_no_html_is_escaped():
    row = html("<li>{a} {b}</li>", a="<i>", b=html("<b>{n}</b>", n=3))
    assert row == "<li>&lt;i&gt; <b>3</b></li>"
    assert isinstance(row, Html)
    assert joined([row, "&"]) == row + "&amp;"
    assert html("{a:.2f}", a=1.234) == "1.23"
    assert html("{a}", a="{b} & {0}") == "{b} &amp; {0}"
