"""LightGBM's text of trees, checked before LightGBM reads it.

LightGBM trusts such a text: a child or a feature that does not exist is read from memory that is
not the trees' own, and a number that is none ends the process. The format is that of
``Booster.model_to_string`` (LightGBM 4, "version=v4").
"""

from __future__ import annotations

import re
from typing import Final

from mvest.errors import InputError

END: Final = "end of trees\n"
OBJECTIVES: Final = ("regression", "binary sigmoid:1", "cross_entropy")
FIXED: Final = {
    "version": "v4",
    "num_class": "1",
    "num_tree_per_iteration": "1",
    "label_index": "0",
}
HEAD: Final = {
    *FIXED, "max_feature_idx", "objective", "feature_names", "feature_infos", "tree_sizes",
}  # fmt: skip
INNER: Final = (
    "split_feature", "split_gain", "threshold", "decision_type", "left_child", "right_child",
    "internal_value", "internal_weight", "internal_count",
)  # fmt: skip
LEAF: Final = ("leaf_value", "leaf_weight", "leaf_count")
TREE: Final = {"Tree", "num_leaves", "num_cat", "is_linear", "shrinkage", *INNER, *LEAF}

_NUMBER = r"-?[0-9]+(?:\.[0-9]*)?(?:e[+-]?[0-9]+)?"
_NUMBERS = re.compile(rf"(?:{_NUMBER}(?: {_NUMBER})*)?")
_WHOLE = re.compile(r"-?[0-9]{1,9}")
_RANGE = re.compile(rf"none|\[{_NUMBER}:{_NUMBER}\]")


def checked_trees(text: str, source: str) -> tuple[str, int]:
    """The text up to its last tree, and how many features the trees look at.

    Parameters
    ----------
    text : str
        As ``Booster.model_to_string`` gives it, or what this function returned.
    source : str
        Named in errors.

    Raises
    ------
    InputError
        If it is no such text, is cut off, or a tree refers to what is not there.
    """
    body, end, _ = text.partition(END)
    starts = [match.start() for match in re.finditer(r"^Tree=", body, flags=re.MULTILINE)]
    try:
        if not end or not starts:
            raise ValueError("cut off or empty")
        blocks = [body[a:b] for a, b in zip(starts, [*starts[1:], len(body)], strict=True)]
        features = _head(body[: starts[0]], [len(block) for block in blocks])
        for number, block in enumerate(blocks):
            _tree(block, number, features)
    except (ValueError, KeyError) as fault:
        raise InputError(f"{source}: no trees that LightGBM wrote ({fault})") from fault
    return body + END, features


def _fields(lines: list[str], expected: set[str]) -> dict[str, str]:
    pairs = [line.partition("=") for line in lines if line]
    fields = {key: value for key, _, value in pairs}
    if set(fields) != expected or len(fields) != len(pairs):
        odd = ", ".join(sorted(set(fields) ^ expected)) or "one more than once"
        raise ValueError(f"fields missing or unknown: {odd[:80]}")
    return fields


def _head(text: str, sizes: list[int]) -> int:
    first, *lines = text.split("\n")
    fields = _fields(lines, set(HEAD))
    count = _whole(fields["max_feature_idx"]) + 1
    right = (
        text.isascii()
        and first == "tree"
        and all(fields[key] == value for key, value in FIXED.items())
        and fields["objective"] in OBJECTIVES
        and count > 0
        and len(fields["feature_names"].split(" ")) == count
        and len(infos := fields["feature_infos"].split(" ")) == count
        and all(_RANGE.fullmatch(info) for info in infos)
        and fields["tree_sizes"] == " ".join(map(str, sizes))
    )
    if not right:
        raise ValueError("header")
    return count


def _tree(text: str, number: int, features: int) -> None:
    fields = _fields(text.split("\n"), TREE)
    leaves = _whole(fields["num_leaves"])
    split = [_whole(v) for v in fields["split_feature"].split()]
    kind = [_whole(v) for v in fields["decision_type"].split()]
    left = [_whole(v) for v in fields["left_child"].split()]
    right = [_whole(v) for v in fields["right_child"].split()]
    for key in (*INNER, *LEAF, "shrinkage"):
        if not _NUMBERS.fullmatch(fields[key]):
            raise ValueError(f"tree {number}, {key}: not numbers")
    single = leaves == 1
    for key in INNER:
        if len(fields[key].split()) != leaves - 1:
            raise ValueError(f"tree {number}, {key}: not {leaves - 1} values")
    for key in LEAF:
        # A tree of a single leaf comes without its weight.
        if len(fields[key].split()) not in ((0, 1) if single else (leaves,)):
            raise ValueError(f"tree {number}, {key}: not {leaves} values")
    # Every inner node but the first and every leaf is some earlier node's child, once.
    children = sorted(left + right)
    every = list(range(-leaves, 0)) + list(range(1, leaves - 1))
    sound = (
        fields["Tree"] == str(number)
        and leaves >= 1
        and fields["leaf_value"] != ""
        and fields["num_cat"] == fields["is_linear"] == "0"
        and all(0 <= feature < features for feature in split)
        and all(0 <= value <= 10 and value % 2 == 0 for value in kind)
        and (single or children == every)
        and all(child < 0 or child > k for side in (left, right) for k, child in enumerate(side))
    )
    if not sound:
        raise ValueError(f"tree {number}: refers to what is not there")


def _whole(text: str) -> int:
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text[:20]!r} is no whole number")
    return int(text)
