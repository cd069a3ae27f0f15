# SPDX-License-Identifier: Apache-2.0
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slam.config import FeaturesConfig
from slam.datasets.cameras import FREIBURG
from slam.geometry import se3
from slam.geometry.features import (
    FeatureExtractor,
    back_project,
    distort,
    grey_of,
    match,
    undistort,
)
from slam.types import Camera, Frame

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
CONFIG = FeaturesConfig()


def frame_of(grey, depth_m=None):
    height, width = grey.shape
    depth_m = np.ones((height, width)) if depth_m is None else depth_m
    rgb = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
    return Frame(0.0, rgb, np.asarray(depth_m, np.float32))


def blocks(seed=0, shape=(240, 320), size_px=8):
    rows, columns = shape[0] // size_px, shape[1] // size_px
    small = np.random.default_rng(seed).integers(0, 256, (rows, columns))
    return small.repeat(size_px, axis=0).repeat(size_px, axis=1)


def extract(frame, config=CONFIG, camera=CAMERA):
    return FeatureExtractor(camera, config).extract(grey_of(frame.rgb), frame.depth_m)


def test_shapes_and_types_are_as_promised():
    features = extract(frame_of(blocks()))
    count = len(features.pixels)
    assert 300 < count <= CONFIG.count
    assert features.pixels.shape == features.undistorted_px.shape == (count, 2)
    assert features.octaves.shape == features.depth_m.shape == (count,)
    assert features.descriptors.shape == (count, 32) and features.points_m.shape == (count, 3)
    assert features.descriptors.dtype == np.uint8 and features.octaves.dtype == np.uint8
    assert {features.pixels.dtype, features.depth_m.dtype, features.points_m.dtype} == {
        np.dtype(np.float32)
    }
    assert features.octaves.min() >= 0 and features.octaves.max() < CONFIG.levels


def test_the_same_image_gives_the_same_features(frames):
    extractor = FeatureExtractor(CAMERA, CONFIG)
    one, other = ((grey_of(each.rgb), each.depth_m) for each in frames[:2])
    first = extractor.extract(*one)
    extractor.extract(*other)
    for again in (extractor.extract(*one), extract(frames[0])):
        for name, values in vars(first).items():
            np.testing.assert_array_equal(values, getattr(again, name), name)


@pytest.mark.parametrize("brightness", [0, 128, 255])
def test_a_blank_image_has_no_features(brightness):
    features = extract(frame_of(np.full((240, 320), brightness)))
    assert {name: values.shape for name, values in vars(features).items()} == {
        "pixels": (0, 2),
        "undistorted_px": (0, 2),
        "octaves": (0,),
        "descriptors": (0, 32),
        "depth_m": (0,),
        "points_m": (0, 3),
    }


@pytest.mark.parametrize("shape", [(24, 32), (40, 40), (39, 320), (1, 1)])
def test_an_image_hardly_larger_than_a_feature_is_no_reason_to_fail(shape):
    noise = np.random.default_rng(0).integers(0, 256, shape)
    features = extract(frame_of(noise), camera=replace(CAMERA, width=shape[1], height=shape[0]))
    assert len(features.pixels) == len(features.descriptors)


def test_no_more_features_than_wanted():
    assert len(extract(frame_of(blocks()), FeaturesConfig(count=50)).pixels) == 50


def test_depth_is_taken_where_the_feature_was_seen():
    v, u = np.mgrid[:240, :320]
    depth_m = 1.0 + 0.01 * u + 0.001 * v
    features = extract(frame_of(blocks(), depth_m))
    expected = 1.0 + [0.01, 0.001] @ np.rint(features.pixels).T
    np.testing.assert_allclose(features.depth_m, expected, rtol=1e-6)


@pytest.mark.parametrize("far_m", [0.02, 6.0, 60.0])
def test_depth_that_is_missing_is_unknown_and_none_is_too_far(far_m):
    depth_m = np.full((240, 320), far_m)
    depth_m[:, 60:120] = 0.0
    depth_m[:, 120:180] = -1.0
    depth_m[:, 180:240] = np.nan
    depth_m[:, 240:] = np.inf
    features = extract(frame_of(blocks(), depth_m))
    is_known = np.rint(features.pixels[:, 0]) < 60
    assert 0 < is_known.sum() < len(is_known)
    np.testing.assert_allclose(features.depth_m[is_known], far_m, rtol=1e-6)
    assert np.isnan(features.depth_m[~is_known]).all()
    assert np.isnan(features.points_m[~is_known]).all()
    np.testing.assert_allclose(features.points_m[is_known, 2], far_m, rtol=1e-6)


@pytest.mark.parametrize("camera", FREIBURG.values(), ids=FREIBURG)
def test_a_point_in_space_projects_to_where_its_feature_was_seen(camera):
    features = extract(frame_of(blocks(shape=(480, 640)), np.full((480, 640), 2.0)), camera=camera)
    projected, _ = cv2.projectPoints(
        features.points_m, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    distance_px = np.linalg.norm(projected.reshape(-1, 2) - features.pixels, axis=1)
    # OpenCV inverts the distortion step by step, least exactly in the corners.
    assert np.median(distance_px) < 0.01 and distance_px.max() < 1.0


def test_undistorting_undoes_the_lens():
    camera = FREIBURG["1"]
    ideal_px = np.stack(np.meshgrid([150.0, 320.0, 500.0], [120.0, 250.0, 380.0]), -1).reshape(
        -1, 2
    )
    rays = back_project(ideal_px, np.ones(9), camera)
    bent_px, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    bent_px = bent_px.reshape(-1, 2)
    assert np.abs(bent_px - ideal_px).max() > 1.0
    np.testing.assert_allclose(undistort(bent_px, camera), ideal_px, atol=0.05)
    np.testing.assert_allclose(distort(ideal_px, camera), bent_px, atol=0.05)


def test_an_ideal_lens_is_left_alone_and_not_aliased():
    pixels = np.array([[1.5, 2.5]])
    undistorted = undistort(pixels, CAMERA)
    np.testing.assert_array_equal(undistorted, pixels)
    undistorted[:] = 0.0
    assert pixels[0, 0] == 1.5
    np.testing.assert_array_equal(distort(pixels, CAMERA), pixels)
    for bend in (undistort, distort):
        assert bend(np.zeros((0, 2)), FREIBURG["1"]).shape == (0, 2)


def test_back_projection_is_the_inverse_of_the_pinhole():
    points_m = np.array([[0.3, -0.2, 1.5], [-1.0, 0.5, 4.0]])
    pixels = points_m @ CAMERA.matrix.T
    found = back_project(pixels[:, :2] / pixels[:, 2:], points_m[:, 2], CAMERA)
    np.testing.assert_allclose(found, points_m)


def cells_of(pixels):
    return [tuple(cell) for cell in (pixels // 40).astype(int)]


def corners(frame, count):
    """Return the pixels and the strengths of the strongest corners by OpenCV's own choice."""
    orb = cv2.ORB.create(nfeatures=count, edgeThreshold=19, fastThreshold=CONFIG.fast_threshold)
    found = orb.detect(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None)
    return np.array([each.pt for each in found]), np.array([each.response for each in found])


def test_features_are_spread_over_the_image_not_crowded_where_it_is_sharpest(frames):
    frame = frames[0]
    spread = cells_of(extract(frame, FeaturesConfig(count=200)).pixels)
    crowded = cells_of(corners(frame, 200)[0])
    assert len(set(spread)) > 1.1 * len(set(crowded))
    assert max(Counter(spread).values()) < 0.8 * max(Counter(crowded).values())


def test_no_cell_is_left_out_while_another_has_two(frames):
    features = extract(frames[0], FeaturesConfig(count=100))
    counts = Counter(cells_of(features.pixels))
    offered = Counter(cells_of(corners(frames[0], 200)[0]))
    assert set(counts) == set(offered)
    fullest = max(counts.values())
    assert all(counts[cell] >= min(offered[cell], fullest - 1) for cell in offered)


def test_of_each_cell_the_strongest_are_taken(frames):
    chosen = {tuple(px) for px in extract(frames[0], FeaturesConfig(count=100)).pixels}
    pixels, strengths = corners(frames[0], 200)
    is_chosen = np.array([tuple(px) in chosen for px in pixels])
    assert is_chosen.sum() >= 100
    cells = np.array(cells_of(pixels))
    for cell in np.unique(cells[~is_chosen], axis=0):
        inside = (cells == cell).all(axis=1)
        assert strengths[inside & is_chosen].min() >= strengths[inside & ~is_chosen].max()


def test_a_pyramid_may_be_higher_than_the_image_allows():
    features = extract(frame_of(blocks()), FeaturesConfig(levels=16, count=2000))
    assert len(features.pixels) > 30
    assert features.octaves.max() == 9  # of 46 rows; one level on they are too few


def test_matches_are_mutual_nearest_and_near_enough():
    rng = np.random.default_rng(3)
    a = extract(frame_of(blocks()))
    descriptors = a.descriptors[:100].copy()
    descriptors[:50, 0] ^= 0b111  # 3 of 256 bits
    order = rng.permutation(100)
    b = replace(extract(frame_of(blocks(seed=9))), descriptors=descriptors[order])
    b = replace(b, pixels=b.pixels[:100])
    unique = replace(a, pixels=a.pixels[:100], descriptors=a.descriptors[:100])
    near, exact = match(unique, b, 3), match(unique, b, 2)
    assert near.dtype == np.int64
    distances = [
        int(np.unpackbits(unique.descriptors[i] ^ b.descriptors[j]).sum()) for i, j in near
    ]
    assert max(distances) == 3 and len(exact) < len(near)
    assert len(set(near[:, 0])) == len(set(near[:, 1])) == len(near)
    table = np.unpackbits(unique.descriptors[:, None] ^ b.descriptors[None], axis=2).sum(axis=2)
    for i, j in near:
        assert table[i, j] == table[i].min() == table[:, j].min()


def test_a_feature_is_in_one_match_only():
    a, b = extract(frame_of(blocks())), extract(frame_of(blocks(seed=9)))
    pairs = match(a, b, 256)
    assert 0 < len(pairs) < min(len(a.pixels), len(b.pixels))
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)


def test_nothing_matches_nothing():
    some, nothing = extract(frame_of(blocks())), extract(frame_of(np.zeros((240, 320))))
    for pair in ((some, nothing), (nothing, some), (nothing, nothing)):
        found = match(*pair, 256)
        assert found.shape == (0, 2) and found.dtype == np.int64


def test_features_follow_a_turn_of_the_camera(frames, T_first_cam):
    reference, query = (extract(frames[i]) for i in (0, 1))
    pairs = match(reference, query, 40)
    points_m = se3.transform(se3.inverse(T_first_cam[1]), reference.points_m[pairs[:, 0]])
    expected = points_m @ CAMERA.matrix.T
    distance_px = np.linalg.norm(
        expected[:, :2] / expected[:, 2:] - query.pixels[pairs[:, 1]], axis=1
    )
    assert len(pairs) > 100 and np.nanmedian(distance_px) < 1.5
