# SPDX-License-Identifier: Apache-2.0
import io

import numpy as np
import pytest
import scipy.io

from placerec.datasets.mat_file import read_mat

MATRIX = np.arange(12).reshape(3, 4)


def saved(compressed=False, **variables):
    stream = io.BytesIO()
    scipy.io.savemat(stream, variables, do_compression=compressed)
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
@pytest.mark.parametrize("compressed", [False, True])
def test_a_matrix_of_any_numbers_is_read_as_scipy_reads_it(kind, compressed):
    content = saved(compressed, other=np.ones(2), name="text", truth=MATRIX.astype(kind))
    assert np.array_equal(read_mat(content, "truth"), MATRIX)
    assert read_mat(content, "tru") is None
    assert read_mat(content, "name") is None


def test_one_number_is_a_small_element():
    assert read_mat(saved(t=np.array([[7]], np.uint8)), "t").tolist() == [[7]]


@pytest.mark.parametrize("end", [0, 50, 127, 130, 150, 200])
def test_what_is_cut_off_is_refused(end):
    with pytest.raises(ValueError, match=r"cut off|not a MATLAB file"):
        read_mat(saved(truth=MATRIX)[:end], "truth")


def test_a_matrix_of_another_size_than_it_says_is_refused():
    content = bytearray(saved(truth=MATRIX.astype("u1")))
    at = content.index(b"\x03\x00\x00\x00\x04\x00\x00\x00")
    for size in (b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff"):
        content[at : at + 4] = size
        with pytest.raises(ValueError, match="not of the size"):
            read_mat(bytes(content), "truth")
