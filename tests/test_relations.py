"""Relations: the file, the revisits of a trajectory, and the errors of one."""

import math

import numpy as np
import pytest

from jaxlocmap.logs import Relations, read_relations, relation_errors, revisits


def composed(a, b):
    """A pose in the frame of another, moved into the frame that the other is in."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return [a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]]


def test_a_file_of_relations(tmp_path):
    path = tmp_path / "a.relations"
    path.write_text("# a comment\n1.5 2.5 0.1 -0.2 9 9 9 0.3\n\n2.5 1.5 1 2 0 0 0 -3\n")
    found = read_relations(path)
    np.testing.assert_array_equal(found.time, [[1.5, 2.5], [2.5, 1.5]])
    np.testing.assert_array_equal(found.moved, [[0.1, -0.2, 0.3], [1, 2, -3]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2 3\n", ":1: expected 8 fields"),
        ("1 2 3 4 5 6 7 8\n1 2 3 4 5 6 7 x\n", ":2: "),
        ("# nothing\n", "expected relations, got none"),
    ],
)
def test_a_file_that_holds_no_relations_is_refused(tmp_path, text, said):
    path = tmp_path / "a.relations"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"^{path}.*{said}"):
        read_relations(path)


def test_the_errors_are_those_put_in():
    """Of a trajectory that agrees with the relations but for a known difference, in the frame of the first pose."""
    time = np.array([10.0, 11.0, 11.005, 30.0])
    moves, errors = (
        np.array([[1, 2, 3.0], [0.5, -0.1, -3.1], [0, 0, 0.2]]),
        np.array([[3e-3, 4e-3, 0.1], [0, 0, 0], [0.1, 0, -0.2]]),
    )
    pairs = [(0, 1), (2, 3), (3, 0)]
    poses = np.zeros((4, 3))
    poses[0] = [5.0, -3.0, 2.0]
    poses[1] = composed(poses[0], moves[0] + errors[0])
    poses[2] = [1.0, 1.0, -1.0]
    poses[3] = composed(poses[2], moves[1])
    c, s = math.cos(poses[3][2]), math.sin(poses[3][2])
    back = poses[0] - poses[3]
    exact = [c * back[0] + s * back[1], c * back[1] - s * back[0], back[2]]
    moves[2] = np.array(exact) - errors[2]
    got = relation_errors(time, poses, Relations(time[np.array(pairs)], moves))
    np.testing.assert_allclose(got.translation, [5e-3, 0, 0.1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.rotation, [0.1, 0, 0.2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.apart, [1, 18.995, -20], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("off", "counted"), [(5e-5, True), (2e-4, False), (-5e-5, True), (-2e-4, False)])
def test_a_moment_that_is_no_stamp_is_left_out(off, counted):
    """Between stamps nothing is known, and the next scan may come 5 ms later."""
    time = np.array([1.0, 1.005, 2.0])
    relation = Relations(np.array([[1.005 + off, 2.0]]), np.zeros((1, 3)))
    assert len(relation_errors(time, np.zeros((3, 3)), relation).translation) == counted


def test_revisits_are_near_in_place_and_far_in_time():
    time = np.arange(100.0)
    poses = np.stack([np.where(time < 50, time, 99 - time), np.zeros(100), np.where(time < 50, 0, math.pi)], axis=-1)
    found = revisits(time, poses)
    a, b = found.time.T.astype(int)
    assert (b - a > 30).all()
    assert (a + b == 99).all()  # a metre away is not near
    assert sorted(a) == list(range(35))
    np.testing.assert_allclose(found.moved, [[0, 0, -math.pi]] * 35, rtol=0, atol=1e-12)
    assert relation_errors(time, poses, found).translation.max() < 1e-12
