"""Shape functions and quadrature of the reference tetrahedra."""

from itertools import product
from math import factorial

import numpy as np
import pytest

from diffsim_ti.mesh.reference_element import LINEAR, MID_EDGES, QUADRATIC, quadrature

CORNERS = np.concatenate([np.zeros((1, 3)), np.eye(3)])
NODES = {1: CORNERS, 2: np.concatenate([CORNERS, CORNERS[MID_EDGES].mean(1)])}
ELEMENTS = pytest.mark.parametrize("element", [LINEAR, QUADRATIC], ids=["linear", "quadratic"])


def monomials(degree: int):
    return [powers for powers in product(range(degree + 1), repeat=3) if sum(powers) <= degree]


def exact(powers) -> float:
    """The mean of x^i y^j z^k over the reference tetrahedron."""
    i, j, k = powers
    return 6 * factorial(i) * factorial(j) * factorial(k) / factorial(i + j + k + 3)


@pytest.mark.parametrize("degree", range(9))
def test_a_rule_is_exact_to_its_degree(degree):
    xi, weights = quadrature(degree)
    assert np.all(weights > 0) and np.all(xi > 0) and np.all(xi.sum(1) < 1)
    for powers in monomials(degree):
        assert weights @ np.prod(xi**powers, 1) == pytest.approx(exact(powers), rel=1e-13)


@ELEMENTS
def test_points_of_stresses_are_exact_to_twice_the_degree_of_the_gradient(element):
    for powers in monomials(element.order if element.order == 2 else 1):
        assert element.weights @ np.prod(element.points**powers, 1) == pytest.approx(exact(powers), rel=1e-13)


@ELEMENTS
def test_functions_are_one_at_their_node_and_make_every_polynomial_of_their_order(element):
    nodes = NODES[element.order]
    assert np.allclose(element.functions(nodes), np.eye(element.num_nodes), atol=1e-14)
    xi = quadrature(4)[0]
    for powers in monomials(element.order):
        assert np.allclose(element.functions(xi) @ np.prod(nodes**powers, 1), np.prod(xi**powers, 1), atol=1e-14)


@ELEMENTS
def test_derivatives_are_those_of_the_functions(element):
    xi, step = quadrature(4)[0], 1e-5
    for d in range(3):
        move = step * np.eye(3)[d]
        difference = (element.functions(xi + move) - element.functions(xi - move)) / (2 * step)
        assert np.allclose(element.derivatives(xi)[..., d], difference, atol=1e-9)


def test_lumped_masses_are_positive_and_whole():
    assert np.allclose(LINEAR.lumped, 1 / 4, atol=1e-15)
    assert np.allclose(QUADRATIC.lumped, [1 / 36] * 4 + [4 / 27] * 6, atol=1e-15)
