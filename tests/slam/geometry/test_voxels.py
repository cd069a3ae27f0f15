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
        points_m, values = rng.normal(size=(5000, 3)), rng.integers(0, 256, (5000, 2))
        values = values.astype(np.float32)
        known, sums_m = np.zeros(5000, np.uint64), np.zeros((5000, 3))
        sums = np.zeros((5000, 2), np.float32)
        count = 0
        for half in (slice(2500), slice(2500, None)):
            table = hash_table(known[:count], 5000)  # made anew of what is known
            added = (numbers[half], points_m[half], values[half])
            count = add_to_voxels(*added, table, known, sums_m, sums, count)
        expected, of = np.unique(numbers, return_inverse=True)
        assert count == len(expected)
        order = np.argsort(known[:count])
        np.testing.assert_array_equal(known[order], expected)
        for found, column in [
            *zip(sums_m.T, points_m.T, strict=True),
            *zip(sums.T, values.T, strict=True),
        ]:
            np.testing.assert_allclose(found[order], np.bincount(of, column), atol=1e-12)
