"""What every test of the application needs."""

import copy
from pathlib import Path

import pytest
from hydra._internal.core_plugins.file_config_source import FileConfigSource


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """Whatever was compiled before: on a fresh installation a note precedes what is tested here.

    That it is given is tested in processes of their own (``test_first_use.py``).
    """
    monkeypatch.setattr("experiments.common.progress.kernels_are_compiled", lambda: True)


@pytest.fixture(autouse=True, scope="session")
def coarse_pictures():
    """Few dots: what is drawn is the same, and nobody looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 40)
        yield


@pytest.fixture(autouse=True, scope="session")
def configuration_files_read_once():
    """Parsing YAML takes a fifth of each of the many hundred configurations that are composed."""
    read, kept = FileConfigSource.load_config, {}

    def load_config(self, config_path):
        place = Path(self.path) / self._normalize_file_name(config_path)
        if not place.is_file():
            return read(self, config_path)
        about = place.stat()
        key = (self.provider, self.path, config_path, about.st_mtime_ns, about.st_size)
        if key not in kept:
            kept[key] = read(self, config_path)
        return copy.deepcopy(kept[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FileConfigSource, "load_config", load_config)
        yield
