# SPDX-License-Identifier: Apache-2.0
import struct
import zlib

import cv2
import numpy as np
import pytest

from placerec.datasets.image_size import image_size
from placerec.datasets.images import BrokenImage, decode_content, find_fault, read_image

KINDS = (".png", ".jpg", ".bmp", ".tiff", ".ppm", ".webp")


def encoded(kind, image=None):
    image = np.zeros((7, 12, 3), np.uint8) if image is None else image
    return cv2.imencode(kind, image)[1].tobytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(7, 12, 3), (300, 2, 3), (1, 257, 3)])
def test_the_header_tells_the_size_that_is_decoded(kind, shape):
    content = encoded(kind, np.full(shape, 90, np.uint8))
    assert image_size(content) == (shape[1], shape[0])


@pytest.mark.parametrize("kind", [".png", ".tiff", ".pgm"])
def test_so_it_does_of_depth(kind):
    assert image_size(encoded(kind, np.ones((480, 640), np.uint16))) == (640, 480)


def test_webp_without_loss_has_another_header():
    image = np.zeros((5, 9, 3), np.uint8)
    lossless = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    assert lossless[12:16] == b"VP8L"
    assert image_size(lossless) == (9, 5)


def test_webp_of_several_chunks_has_a_third():
    start = b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0" + bytes(4)
    assert image_size(start + b"\x3f\x00\x01\x0f\0\0") == (0x10040, 16)


def test_comments_of_a_pnm_are_no_sizes():
    assert image_size(b"P5\n# 9 9\n# by hand\n4\t3 255\n" + bytes(12)) == (4, 3)


def test_big_endian_tiff():
    entries = struct.pack(">HHIHHHHIHH", 256, 3, 1, 70, 0, 257, 3, 1, 50, 0)
    assert image_size(b"MM\0*" + struct.pack(">IH", 8, 2) + entries) == (70, 50)


@pytest.mark.parametrize("kind", KINDS)
def test_every_beginning_of_an_image_is_a_size_or_refused(kind):
    whole = encoded(kind)
    for end in range(min(len(whole), 200)):
        try:
            assert len(image_size(whole[:end])) == 2
        except ValueError as error:
            assert str(error) == "not a readable image"


def claiming(kind, width, height):
    content = bytearray(encoded(kind))
    if kind == ".png":
        content[16:24] = struct.pack(">II", width, height)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    elif kind == ".bmp":
        content[18:26] = struct.pack("<ii", width, -height)
    elif kind == ".jpg":
        at = content.index(b"\xff\xc0") + 5
        content[at : at + 4] = struct.pack(">HH", height, width)
    else:
        content = bytearray(content.replace(b"12 7", f"{width} {height}".encode()))
    return bytes(content)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".jpg", ".ppm"])
def test_an_image_that_claims_too_many_pixels_is_not_decoded(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    path = tmp_path / f"bomb{kind}"
    path.write_bytes(claiming(kind, 30000, 30000))
    for read in (read_image, find_fault):
        why = read(path).why
        assert why == "an image of 30000x30000 pixels, more than 67 million"


def test_a_jpeg_of_a_thousand_passes_is_not_decoded(tmp_path):
    content = encoded(".jpg")
    scan = content[content.index(b"\xff\xda") : -2]
    content = content[:-2] + 1000 * scan + content[-2:]
    assert isinstance(decode_content(content, tmp_path, cv2.IMREAD_COLOR), BrokenImage)


def test_images_of_other_kinds_are_not_guessed_at(tmp_path):
    content = cv2.imencode(".jp2", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    found = decode_content(content, tmp_path, cv2.IMREAD_COLOR)
    assert found == BrokenImage(tmp_path, "not a readable image")


def test_a_png_whose_chunk_is_longer_than_the_file_is_not_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    content = encoded(".png")
    at = content.index(b"IDAT")
    content = content[: at - 4] + b"\x7f\xff\xff\xff" + content[at:]
    assert decode_content(content, tmp_path, cv2.IMREAD_COLOR).why == "not a readable image"


def test_a_big_tiff_whose_table_is_nowhere_is_not_readable():
    content = b"II+\0" + struct.pack("<HHQ", 8, 0, 2**64 - 1) + bytes(40)
    with pytest.raises(ValueError, match="not a readable image"):
        image_size(content)
