"""What a configuration is composed of before values are set, kept within a process of tests.

Hydra merges the chosen files and schemas anew for each of the many hundred configurations that are
composed, which takes most of the time of testing the application. What it merges follows from the
choices of groups and from the files alone; the values of the command line are set on a copy.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, Overrides

from tests.places import CONF

MAKE_LIST = config_loader_impl.create_defaults_list
MERGE = ConfigLoaderImpl._compose_config_from_defaults_list
"""What Hydra itself does."""


def _files(repo: Any) -> tuple[Any, ...] | None:
    """The sources and when their files were changed; None where there are others than usual."""
    sources = tuple(
        (source.provider, source.scheme(), source.path) for source in repo.get_sources()
    )
    places = {path for _, scheme, path in sources if scheme == "file"}
    if places != {str(CONF)}:
        return None
    files = ((str(path), path.stat().st_mtime_ns) for path in Path(CONF).rglob("*.yaml"))
    return sources, tuple(sorted(files))


@contextmanager
def composed_once() -> Iterator[None]:
    """Merge what the same choices name once only."""
    lists: dict[Any, tuple[Any, dict[str, Any]]] = {}
    merged: dict[Any, Any] = {}

    def create_defaults_list(
        repo: Any, config_name: Any, overrides_list: Any, prepend_hydra: Any, skip_missing: Any
    ) -> DefaultsList:
        files = _files(repo)
        if files is None:
            return MAKE_LIST(repo, config_name, overrides_list, prepend_hydra, skip_missing)
        chosen = Overrides(repo, overrides_list)
        choices = (chosen.override_choices, chosen.append_group_defaults, chosen.deletions)
        key = (files, config_name, prepend_hydra, skip_missing, repr(choices))
        if key not in lists:
            made = MAKE_LIST(repo, config_name, overrides_list, prepend_hydra, skip_missing)
            lists[key] = copy.deepcopy((made.defaults, made.overrides.known_choices))
            return made
        defaults, chosen.known_choices = copy.deepcopy(lists[key])
        # The tree is for messages about what was chosen wrongly, which was not.
        return DefaultsList(defaults, None, chosen.config_overrides, chosen)

    def compose(self: Any, defaults: Any, repo: Any) -> Any:
        files = _files(repo)
        if files is None:
            return MERGE(self, defaults, repo)
        key = (files, repr(defaults))
        if key not in merged:
            merged[key] = MERGE(self, defaults, repo)
        return copy.deepcopy(merged[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config_loader_impl, "create_defaults_list", create_defaults_list)
        patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", compose)
        yield
