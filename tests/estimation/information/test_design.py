"""Designs: information adds up, and the noise that is said to be needed is."""

import numpy as np
import pytest
from scipy.linalg import cholesky

from mvest.errors import InputError
from mvest.estimation.information.design import Design, together
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.noise import kronecker_noise

NAMES = ("E", "rest", "pressure")
VALUES = np.array([5.0, 1.0, 1.0])
rng = np.random.default_rng(3)
H = rng.standard_normal((30, 3)) * [0.1, 8.0, 2.0]
DESIGN = Design.of(H, 1.0, VALUES, NAMES)


def test_a_design_has_the_bound_of_the_whole_observation():
    whole = identifiability(H, 0.25, VALUES, names=NAMES)
    np.testing.assert_allclose(DESIGN.at(0.5).std, whole.std / VALUES, rtol=1e-12)
    np.testing.assert_allclose(DESIGN.at(0.5).correlation, whole.correlation, rtol=1e-10)


def test_what_is_known_is_left_out_and_what_is_half_known_is_one_more_observation():
    # (H'H/σ² + P^-1)^-1 by hand, in parts of the values.
    S = H * VALUES
    A = S.T @ S / 0.01 + np.diag([0.0, 1.0 / 0.02**2, 0.0])
    found = DESIGN.at(0.1, {"rest": 0.02})
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(np.linalg.inv(A))), rtol=1e-10)
    fixed = DESIGN.at(0.1, {"rest": 0.0, "pressure": 0.0})
    assert fixed.names == ("E",)
    assert fixed.std == pytest.approx(0.1 / np.linalg.norm(S[:, 0]))


@pytest.mark.parametrize("knowledge", [{}, {"rest": 0.0}, {"rest": 0.02, "pressure": 0.1}])
def test_the_needed_noise_put_back_in_gives_the_target(knowledge):
    noise = DESIGN.needed_noise("E", 0.05, knowledge)
    assert 0.0 < noise < np.inf
    assert DESIGN.std("E", noise, knowledge) == pytest.approx(0.05, rel=1e-9)
    if not knowledge or 0.0 in knowledge.values():
        # Nine of the same observation together are nine times the information.
        assert together(*[DESIGN] * 9).std("E", 3.0 * noise, knowledge) == pytest.approx(0.05)


def test_no_noise_is_small_enough_where_a_nuisance_hides_the_parameter():
    # Both columns are one: E is known as well as the nuisance is beforehand, to 10 %.
    hidden = np.stack([np.arange(1.0, 5.0), np.arange(1.0, 5.0)], axis=1)
    design = Design.of(hidden, 1.0, np.ones(2), ("E", "pressure"))
    assert design.needed_noise("E", 0.05, {"pressure": 0.1}) == 0.0
    assert design.needed_noise("E", 0.05) == 0.0
    assert design.std("E", 1.0) == np.inf
    assert design.needed_noise("E", 0.2, {"pressure": 0.1}) > 0.0
    assert design.needed_noise("E", 0.05, {"E": 0.04}) == np.inf


def test_together_is_the_stacked_observation_with_its_own_noises():
    # The second observation's noise is correlated, and in units of twice the first's.
    C = np.array([[1.0, 0.6], [0.6, 1.0]])
    more = rng.standard_normal((6, 3))
    second = Design.of(more, kronecker_noise(4.0, cholesky(C, lower=True), 3), VALUES, NAMES)
    both = together(DESIGN, second)
    inverse = np.kron(np.linalg.inv(C), np.eye(3)) / 4.0
    A = (H * VALUES).T @ (H * VALUES) + (more * VALUES).T @ inverse @ (more * VALUES)
    np.testing.assert_allclose(both.at(1.0).information, A, rtol=1e-10)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Design.of(H, 1.0, np.array([5.0, 0.0, 1.0]), NAMES), "expected > 0"),
        (lambda: DESIGN.at(0.1, {"stiffness": 0.1}), "expected deviations"),
        (lambda: DESIGN.at(0.1, dict.fromkeys(NAMES, 0.0)), "every parameter is known"),
        (lambda: together(DESIGN, Design.of(H, 1.0, 2.0 * VALUES, NAMES)), "same parameters"),
    ],
)
def test_bad_designs_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
