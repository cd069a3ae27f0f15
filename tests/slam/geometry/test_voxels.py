# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.geometry.voxels import add_to_voxels, hash_table, voxel_numbers


def test_points_of_one_voxel_have_one_number_and_neighbours_others():
    corners = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3), axis=-1).reshape(-1, 3)
    numbers = voxel_numbers(0.1 * corners + 0.01, 0.1)
    assert len(set(numbers.tolist())) == len(corners)
    np.testing.assert_array_equal(voxel_numbers(0.1 * corners + 0.09, 0.1), numbers)


def test_sums_are_those_of_all_values_with_one_number_however_the_numbers_fall():
    rng = np.random.default_rng(0)
    for spread in (1, 2**20, 2**56):  # low bits alone, or high ones alone, tell numbers apart
        numbers = rng.integers(0, 200, 5000).astype(np.uint64) * np.uint64(spread)
        values = rng.normal(size=(5000, 2))
        known, sums = np.zeros(5000, np.uint64), np.zeros((5000, 2))
        table = hash_table(known[:0], 5000)
        half = add_to_voxels(numbers[:2500], values[:2500], table, known, sums, 0)
        table = hash_table(known[:half], 5000)  # made anew of what is known
        count = add_to_voxels(numbers[2500:], values[2500:], table, known, sums, half)
        expected, of = np.unique(numbers, return_inverse=True)
        assert count == len(expected)
        order = np.argsort(known[:count])
        np.testing.assert_array_equal(known[order], expected)
        for column in range(2):
            exact = np.bincount(of, values[:, column])
            np.testing.assert_allclose(sums[order, column], exact, atol=1e-12)
