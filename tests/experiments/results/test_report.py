import json
from dataclasses import asdict
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from experiments.results.page import write_report
from experiments.sweeps.collected import Sweep
from experiments.sweeps.report import write_sweep
from experiments.tables import main
from mvest.errors import InputError
from mvest.provenance import sealed
from tests.experiments.sweeps.synthetic_sweeps import (
    TRUTH,
    all_failed,
    empty,
    job,
    noise,
    run,
    sweep,
)
from tests.reporting.records import record, stored

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


def publish(results, whole: Sweep, *, files: bool = True) -> None:
    (results / "sweeps").mkdir(exist_ok=True)
    path = results / "sweeps" / f"{whole.name}.json"
    path.write_text(json.dumps(sealed(asdict(whole))), encoding="utf-8")
    if files:
        write_sweep(results, whole)


def small(**changes) -> Sweep:
    jobs = [job({"filter": name}, [run(1, TRUTH * 1.02, [0.1, 0.1])]) for name in ("ekf", "iekf")]
    return sweep("filter", [*jobs, job({"filter": "lost"}, [], "killed (signal 9)")], **changes)


def test_a_report_needs_nothing_but_itself(tmp_path) -> None:
    publish(tmp_path, small())
    publish(tmp_path, noise(2), files=False)
    (tmp_path / "gate.md").write_text("# Gate\n\n| a |\n|---|\n| b |\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert page.tags.count("img") == 2
    inside = [a for a in page.addresses if a.startswith("#")]
    # What validates the model comes before what was studied with it.
    assert inside == ["#gate", "#sweep_noise", "#sweep_filter"]
    assert [a.removeprefix("#") for a in inside] == page.anchors
    for address in page.addresses:
        local = not address.startswith(("data:", "#")) and (tmp_path / address).is_file()
        assert address.startswith(("data:image/webp;base64,", "#")) or local
    assert "url(" not in text
    assert "@import" not in text


def test_a_section_says_what_was_asked_found_kept_and_lost(tmp_path) -> None:
    publish(tmp_path, small())
    text = write_report(tmp_path).read_text(encoding="utf-8")
    for words in (
        "Which filter finds the moduli",
        "The smallest error is that of “ekf”: 2 %",
        "killed (signal 9)",
        "1 of 3 runs failed",
        "ekf, iekf, lost",
        "max_iterations",
        "commit 0123456789ab",
        "Of 3 requests for a simulated truth, 2 were served from the store.",
        "<strong>simulated</strong>",
    ):
        assert words in text


def test_settings_of_the_machine_stay_out(tmp_path) -> None:
    settings = {"paths": {"outputs": "somewhere/private"}, "mesh": {"columns": 36}, "force": True}
    publish(tmp_path, small(settings=settings), files=False)
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "mesh.columns" in text
    assert "somewhere" not in text


def test_equal_results_give_an_equal_page(tmp_path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        publish(tmp_path / name, small())
    first, second = (write_report(tmp_path / name).read_bytes() for name in ("a", "b"))
    assert first == second
    (tmp_path / "b" / "sweep_filter.png").unlink()
    assert write_report(tmp_path / "b").read_bytes() != first


def test_hostile_text_is_shown_and_not_obeyed(tmp_path) -> None:
    whole = sweep(
        "filter",
        [job({"filter": HOSTILE}, [], HOSTILE, row=HOSTILE)],
        title=HOSTILE,
        settings={HOSTILE: HOSTILE},
    )
    publish(tmp_path, whole)
    (tmp_path / "gate.md").write_text(f"# {HOSTILE}\n\n{HOSTILE}\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert "script" not in page.tags
    assert not any("example.org" in address for address in page.addresses)
    assert "&lt;script&gt;alert" in text


@pytest.mark.parametrize("whole", [empty, all_failed])
def test_sweeps_without_any_result_have_their_section(tmp_path, whole) -> None:
    publish(tmp_path, whole("noise"), files=False)
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert Page(text).open == []
    assert ("The sweep has no jobs" if whole is empty else "None of the 800 runs converged") in text


def test_without_a_sweep_the_page_says_how_to_run_one(tmp_path) -> None:
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "python -m experiments.run -m sweep=noise" in text
    assert Page(text).open == []


def test_large_pictures_become_small(tmp_path) -> None:
    rng = np.random.default_rng(0)
    pixels = np.repeat(np.repeat(rng.integers(0, 255, (30, 60, 3)), 50, 0), 50, 1)
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "closure.png")
    (tmp_path / "closure.md").write_text("# Closing\n\ntext\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert 'width="1500" height="750"' in text
    (tmp_path / "closure.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"cannot read the picture .*closure\.png"):
        write_report(tmp_path)


def test_tables_are_made_again_from_published_sweeps_alone(tmp_path, capsys) -> None:
    publish(tmp_path, small())
    before = {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    for name in before:
        (tmp_path / name).unlink()
    assert main([str(tmp_path)]) == 0
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    assert "report.html" in capsys.readouterr().out
    place = tmp_path / "records" / "table1"
    place.mkdir(parents=True)
    (place / "table1.json").write_text(json.dumps(sealed(stored(record()))), encoding="utf-8")
    assert main([str(tmp_path)]) == 0
    assert "Moduli of a synthetic valve" in (tmp_path / "report.html").read_text(encoding="utf-8")
    (tmp_path / "sweeps" / "filter.json").write_text("{", encoding="utf-8")
    assert main([str(tmp_path)]) == 2
    assert "filter.json is not JSON" in capsys.readouterr().err


def test_an_empty_folder_still_says_what_to_run(tmp_path, capsys) -> None:
    assert main([str(tmp_path)]) == 2
    assert "experiment=table1" in capsys.readouterr().err
