"""The page of all results: it needs nothing else, and nothing that a run said acts on it."""

from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from experiments.cli import main
from experiments.results.published import publish
from experiments.studies.twin import STUDY
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import write_sweep
from experiments.tables import write_report
from mvest.errors import InputError
from tests.experiments.studies.made_up import made_up_twin
from tests.experiments.sweeps.made_up_sweeps import TRUTH, job, run, sweep

HOSTILE = "<script>alert('x')</script><img src=http://example.org/x>"


class Page(HTMLParser):
    """Tags, addresses and anchors of a page, and whether every tag is closed."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.anchors: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        named = dict(attrs)
        self.addresses += [named[key] or "" for key in ("src", "href") if key in named]
        if "id" in named:
            self.anchors.append(named["id"] or "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def publish_sweep(results, whole: Sweep) -> None:
    (results / "sweeps").mkdir(exist_ok=True)
    write_sweep_file(results / "sweeps" / f"{whole.name}.json", whole)
    write_sweep(results, whole)


def small(**changes) -> Sweep:
    jobs = [job({"filter": name}, [run(1, TRUTH * 1.02, [0.1, 0.1])]) for name in ("ekf", "iekf")]
    return sweep("filter", [*jobs, job({"filter": "lost"}, [], "killed (signal 9)")], **changes)


def picture(path, width: int = 60, height: int = 30) -> None:
    Image.fromarray(np.zeros((height, width, 3), dtype=np.uint8)).save(path)


def test_a_report_needs_nothing_but_itself(tmp_path) -> None:
    publish_sweep(tmp_path, small())
    (tmp_path / "gate.md").write_text("# Gate\n\n| a |\n|---|\n| b |\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert page.tags.count("img") == 1
    assert page.anchors == ["gate", "sweep_filter"]
    assert [a for a in page.addresses if a.startswith("#")] == ["#gate", "#sweep_filter"]
    assert all(a.startswith(("data:image/webp;base64,", "#")) for a in page.addresses)
    assert "url(" not in text
    assert "@import" not in text
    assert "killed (signal 9)" in text
    assert "<strong>simulated</strong>" in text


def test_each_picture_stands_once_in_the_section_of_the_longest_name(tmp_path) -> None:
    for name in ("imaging", "imaging_std"):
        (tmp_path / f"{name}.md").write_text(f"# {name}\n", encoding="utf-8")
    (tmp_path / "imaging.md").write_text(
        "# Imaging\n\n![How far \\| &lt;a&gt;](imaging.png)\n\n![x](http://example.org/x.png)\n",
        encoding="utf-8",
    )
    for name in ("imaging", "imaging_distance", "imaging_std", "imaging_std_more", "dashboard"):
        picture(tmp_path / f"{name}.png")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    first, second = text.split("<section")[1:]
    assert (first.count("<img"), second.count("<img")) == (2, 2)
    assert 'alt="How far | &lt;a&gt;"' in first
    # A picture from elsewhere is not loaded.
    assert Page(text).tags.count("img") == 4


def test_equal_results_give_an_equal_page(tmp_path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        publish_sweep(tmp_path / name, small())
    first, second = (write_report(tmp_path / name).read_bytes() for name in ("a", "b"))
    assert first == second
    (tmp_path / "b" / "sweep_filter.png").unlink()
    assert write_report(tmp_path / "b").read_bytes() != first


def test_hostile_text_is_shown_and_not_obeyed(tmp_path) -> None:
    hostile = job({"filter": HOSTILE}, [], HOSTILE, row=HOSTILE)
    publish_sweep(tmp_path, sweep("filter", [hostile], title=HOSTILE))
    (tmp_path / "gate.md").write_text(f"# {HOSTILE}\n\n{HOSTILE}\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert "script" not in page.tags
    assert not any("example.org" in address for address in page.addresses)
    assert "&lt;script&gt;alert" in text


def test_large_pictures_become_small(tmp_path) -> None:
    picture(tmp_path / "closure.png", 3000, 1500)
    (tmp_path / "closure.md").write_text("# Closing\n\ntext\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert 'width="1500" height="750"' in text
    (tmp_path / "closure.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"cannot read the picture .*closure\.png"):
        write_report(tmp_path)


def test_tables_are_made_again_from_published_sweeps_alone(tmp_path, capsys) -> None:
    publish_sweep(tmp_path, small())
    before = {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    for name in before:
        (tmp_path / name).unlink()
    assert main(["tables", str(tmp_path)]) == 0
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    assert "report.html" in capsys.readouterr().out
    publish(STUDY, tmp_path, {"table1": (made_up_twin(), tmp_path / "no such folder")})
    assert main(["tables", str(tmp_path)]) == 0
    assert "Moduli of a synthetic valve" in (tmp_path / "report.html").read_text(encoding="utf-8")
    (tmp_path / "sweeps" / "filter.json").write_text("{", encoding="utf-8")
    assert main(["tables", str(tmp_path)]) == 2
    assert "filter.json is not JSON" in capsys.readouterr().err


def test_an_empty_folder_still_says_what_to_run(tmp_path, capsys) -> None:
    assert main(["tables", str(tmp_path)]) == 2
    assert "experiment=table1" in capsys.readouterr().err
