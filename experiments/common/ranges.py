"""What every setting may be: one table of ranges, by the names of settings.

A name holds wherever it stands in a configuration, ``columns`` for ``mesh.columns`` as for
``personal.mesh.columns``; the first row that has it counts. What a study adds is in a range where
its name says its unit, and a test refuses a number that is in none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import Any

from mvest.errors import ConfigurationError, InputError
from mvest.reading.text import check_words

__all__ = ["ANY", "RANGES", "Range", "range_of", "require_in_range"]


@dataclass(frozen=True, slots=True)
class Range:
    """What a kind of settings may be.

    Attributes
    ----------
    low, high : float
        The ends, which are within.
    unit : str
    why : str
    names : str
        Settings, the ends of their dotted names; ``*`` is any text, dots included.
    """

    low: float
    high: float
    unit: str
    why: str
    names: str

    def require(self, name: str, value: float) -> None:
        """Raise `ConfigurationError` unless a value is in the range."""
        if not self.low <= value <= self.high:
            # An integer may be larger than any float.
            shown = f"{Decimal(value) if isinstance(value, int) else value:.10g}"
            raise ConfigurationError(f"{name} = {shown}, expected {self} ({self.why})")

    def __str__(self) -> str:
        return f"{self.low:.10g} to {self.high:.10g} {self.unit}".rstrip()


RANGES = (
    # What runs.
    Range(0, 2**32 - 1, "", "what random generators take", "seed surrogate_seed"),
    Range(0.01, 2_592_000, "s", "up to 30 days; longer is no limit", "time_limit_s"),
    Range(0.1, 100_000, "GB", "more than any machine has is no limit", "memory_limit_gb"),
    Range(0.01, 3600, "s", "an hour is too long to notice an end", "launcher.poll_s"),
    Range(1, 525_600, "min", "up to a year", "launcher.timeout_min"),
    Range(0.01, 100_000, "GB", "the memory of one task", "launcher.mem_gb"),
    Range(-1024, 1024, "", "processes of one machine; -1: one for each core", "launcher.n_jobs"),
    Range(1, 1024, "", "processes of one machine", "processes threads cpus_per_task"),
    Range(1, 1_000_000, "", "jobs and tasks of a sweep", "jobs_per_task array_parallelism"),
    Range(0, 65_535, "", "ports of a machine; 0: one that is free", "port"),
    # Meshes and points.
    Range(1, 4, "", "each doubling takes eight times the memory", "truth.refine"),
    Range(
        3, 1000, "", "points around the valve",
        "observation.columns contact_points.columns contact_columns seen_columns motion.columns",
    ),
    Range(
        2, 500, "", "points from the annulus to the free edge",
        "observation.rows contact_points.rows contact_rows seen_rows motion.rows",
    ),
    Range(
        1, 400, "", "cells around the valve: of at least 0.3 mm",
        "columns guide_columns mesh_columns finer_columns check_columns",
    ),
    Range(
        1, 60, "", "cells from the annulus to the free edge: of at least 0.3 mm",
        "rows guide_rows mesh_rows finer_rows check_rows",
    ),
    Range(1, 16, "", "cells through the thickness of a leaflet", "layers"),
    Range(
        1, 1000, "", "numbers of cells, points or voxels along an axis",
        "refinements extrapolated_from check_mesh stress_meshes finer_contact check_contact "
        "sheet.cells sheet.observed acquisition.shape",
    ),
    Range(0.1, 20, "mm", "edges of the cells of a leaflet", "edge_length"),
    # The heart.
    Range(
        -100,
        500,
        "mmHg",
        "no heart makes more; below zero it opens the valve",
        "*pressure_mmHg *pressures_mmHg",
    ),
    Range(0, 100, "mmHg", "errors of pressures", "*offset_mmHg *each_mmHg"),
    Range(0, 10_000, "", "a frame and, in mmHg, its pressure", "imaged.held_out imaged.landmarks"),
    Range(0.01, 10, "mm", "no leaflet is thicker", "*thickness *thickness_mm"),
    Range(1e-5, 10, "s", "time steps of a beat", "dt cycle_dt time_steps"),
    Range(
        0, 60, "s", "times within heartbeats",
        "ramp end rise fall protocol.hold beat_times cycle_times times duration frame_interval_s "
        "smoothing_s",
    ),
    Range(
        -360, 360, "degrees", "once around",
        "*_deg *_degrees commissure_angle fibre_turn marginal_phi chordae.absent chordae.basal "
        "chordae.elongated turn.?.mean turn.?.std turn.?",
    ),
    Range(
        -1000, 1000, "mm", "places within a body",
        "annulus_offset_mm position_mm displacement tip centre shift.?.mean shift.?.std shift.? "
        "sag drop middle_z anterior_depth posterior_depth commissural_y saddle_height "
        "held_tips edge_gap edge_height",
    ),
    Range(
        0, 1000, "mm", "sizes and distances within a body",
        "*_mm tip_motion half_width *_half_axis length commissural_length sheet.width "
        "annuloplasty.mm patch_radius largest_move smallest_move",
    ),
    Range(0, 10_000, "mm/s", "no leaflet is faster", "speed_mm_s"),
    Range(0, 1000, "%", "shares of a whole, and their errors", "percent *_percent"),
    # Tissue and forces.
    Range(
        1e-6, 10_000, "MPa", "from 1 Pa, less than any gel has, to what bone has",
        "E_f.* G.* c0 c0.* mu mu.* kappa kappa.* viscous reference_pressure "
        "donor.starts paper_moduli paper.estimate",
    ),
    Range(0, 100_000, "", "exponents of the exponential law", "c1 c1.* c2 c2.*"),
    Range(0.001, 1000, "", "one modulus over another", "ratio ratio.*"),
    Range(0, 1e6, "", "one law over another", "stiffening stiffening.*"),
    Range(0, 5, "", "leaflets are not seen five times as long", "prestretch prestretch.*"),
    Range(-1, 0.4999, "", "stable, and not quite incompressible", "nu poisson"),
    Range(
        0, 100_000, "N, N/mm or N/mm²", "far stiffer than what it holds",
        "marginal_stiffness basal_stiffness support_stiffness clip.stiffness",
    ),
    Range(1e-12, 1e-7, "t/mm³", "water has 1e-9", "density"),
    Range(
        0, 1000, "1/s or s", "nothing moves that is damped more",
        "alpha beta damping damping.mean damping.std",
    ),
    Range(0, 20, "", "multiples of the thickness", "reference_distance activation_distance"),
    Range(
        0, 100, "", "factors and exponents",
        "errors.*_factor errors.deviation length_factor "
        "*_slack dt_factor finer_dt_factor growth factor scale *exponent stretch orifice "
        "pressure_scale* chord_stiffness* chord_rest_length chord_rest_length.* largest_r_hat",
    ),
    # Shares, statistics and numerics.
    Range(
        0, 1, "", "shares of a whole",
        "share share_* other_share "
        "anterior_flattening *_contraction belly_depth edge_thinning toe_strain "
        "closed_depth closures.* marginal_s *confidence dropout rate *_relaxation held_pressure "
        "missing outliers *_off lost_by rest_lengths",
    ),
    Range(1e-15, 1, "", "relative tolerances and steps", "*tolerance relative_step"),
    Range(-1e12, 1e12, "", "variances, in the units of any model squared", "P0 Q R"),
    Range(
        -1e12, 1e12, "", "parameters, in the units of any model; those of this one are also in "
        "the ranges of what they are",
        "heart.twins.* truth.values filter.initial methods.*.initial problems.*.truth "
        "problems.*.initial prior_std external.floor",
    ),
    Range(
        -10, 10, "", "of logarithms, or of standard normal numbers",
        "*_spread spread std_log log_std *_std drift deviations.pressure variation *reach "
        "reach.* knowledge.* target largest_change width field.*",
    ),
    Range(0, 20, "", "of polynomials; above, all is round-off", "degree"),
    Range(0, 60, "", "halvings of a step; after more nothing is left of it", "max_halvings"),
    Range(1, 100_000, "", "observations, each of which is estimated from", "repeats"),
    Range(
        0, 100_000, "", "numbers of things that each take their time",
        "seeds steps max_* runs checks members walkers chains samples further_samples "
        "patients every modes points path_steps beats held_out held_out.* count vertices "
        "contact_vertices *_runs error_samples open_frame closed_frame curve hypotheses shared "
        "frames crossings volumes draft_volumes trees many_trees leaves min_leaf_samples "
        "samples.* load_steps least_effective renewals",
    ),
    # The simulated scanner, and the fit to what it sees.
    Range(-200, 200, "dB", "levels, per cm and MHz where they fall", "*_db *_db_per_cm*"),
    Range(0.1, 100, "MHz", "ultrasound", "frequency_mhz"),
    Range(0, 1000, "", "weights and densities", "scatterers_per_cell fit.stiffness fit.hold alike"),
)  # fmt: skip
"""Every setting's range; where names of two rows fit, the first counts."""

ANY = Range(-1e15, 1e15, "", "no setting is larger", "*")
"""Of a number that no row names: a factor of a sweep, a setting of another program."""

MAX_ENTRIES, MAX_LETTERS, MAX_NAME = 10_000, 10_000, 120
"""Of a list or mapping, of a text, and of a text that names files."""

NAMES_OF_FILES = ("name", "table", "study")

PER_PARAMETER = (("truth", "values"), ("filter", "initial"))
"""Lists of one value for each of ``parameters``."""

OTHER_MODEL = "external"
"""The study whose parameters are another model's, whatever they are called."""


@cache
def range_of(key: str) -> Range:
    """The range of a setting by its dotted name."""
    return next((row for row, names in _patterns() if names.search(key)), ANY)


@cache
def _patterns() -> tuple[tuple[Range, re.Pattern[str]], ...]:
    any_text = {r"\*": ".*", r"\?": "[^.]"}
    found = []
    for row in RANGES:
        names = "|".join(map(re.escape, row.names.split()))
        for mark, pattern in any_text.items():
            names = names.replace(mark, pattern)
        found.append((row, re.compile(rf"(?:^|\.)(?:{names})\Z", re.DOTALL)))
    return tuple(found)


def require_in_range(values: Mapping[str, Any]) -> None:
    """Refuse a configuration with a number outside its range, or a text that is none.

    Parameters
    ----------
    values : mapping
        Plain data, resolved.

    Raises
    ------
    ConfigurationError
        One line with the setting, its value and the range.
    """
    _require("", values)
    if values.get("study") == OTHER_MODEL:
        return
    for part, name in PER_PARAMETER:
        given = (values.get(part) or {}).get(name)
        if isinstance(given, list):
            for parameter, value in zip(values.get("parameters") or (), given, strict=False):
                if isinstance(value, int | float):
                    range_of(str(parameter)).require(f"{part}.{name} of {parameter}", value)


def _require(key: str, value: Any) -> None:
    match value:
        case bool() | None:
            return
        case int() | float():
            range_of(key).require(key, value)
        case str():
            longest = MAX_NAME if key in NAMES_OF_FILES else MAX_LETTERS
            try:
                check_words(value, longest)
            except InputError as error:
                raise ConfigurationError(f"{key} has {error}") from error
        case Mapping() | Sequence():
            if len(value) > MAX_ENTRIES:
                raise ConfigurationError(
                    f"{key} has {len(value)} entries, expected at most {MAX_ENTRIES}"
                )
            if isinstance(value, Mapping):
                for name, part in value.items():
                    _require(f"{key}.{name}" if key else str(name), part)
            else:
                for part in value:
                    _require(key, part)
