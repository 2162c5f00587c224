import pytest

from experiments.common.building.filters import filter_of
from mvest.errors import ConfigurationError
from mvest.estimation.filters.paper import PaperFilter

PAPER = "mvest.estimation.filters.paper.PaperFilter"


def test_a_filter_is_made_of_its_name_and_settings() -> None:
    made = filter_of({"_target_": PAPER, "max_iterations": 3})
    assert isinstance(made, PaperFilter)
    assert made.max_iterations == 3


@pytest.mark.parametrize(
    "function",
    ["mvest.files.write_atomically", "mvest.estimation.filters.paper.write_atomically"],
)
def test_a_configuration_calls_no_function(tmp_path, monkeypatch, function) -> None:
    from mvest import files
    from mvest.estimation.filters import paper

    # As if the filter's module had imported it.
    monkeypatch.setattr(paper, "write_atomically", files.write_atomically, raising=False)
    call = {"_target_": function, "path": str(tmp_path / "written"), "content": "text"}
    with pytest.raises(ConfigurationError, match="expected the full name of a filter"):
        filter_of(call)
    for hidden in (call, [[call]], {"inner": call}):
        filter_of({"_target_": PAPER, "Q": hidden})
    assert not (tmp_path / "written").exists()


@pytest.mark.parametrize(
    "target", [None, 3, "mvest.estimation.filters.paper.NoFilter", "pathlib.Path"]
)
def test_what_is_no_filter_of_ours_is_refused(target) -> None:
    with pytest.raises(ConfigurationError, match="expected the full name of a filter"):
        filter_of({"_target_": target})


def test_an_unknown_setting_is_one_clear_error() -> None:
    with pytest.raises(ConfigurationError, match="unexpected keyword argument 'steepness'"):
        filter_of({"_target_": PAPER, "steepness": 2})
