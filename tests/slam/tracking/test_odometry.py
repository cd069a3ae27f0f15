# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from slam.config import Config, OdometryConfig
from slam.geometry import se3
from slam.geometry.motion_noise import translation_sigma_m
from slam.tracking.odometry import RgbdOdometry, TrackedFrame
from slam.tracking.trails import Trails
from slam.types import Camera, Frame, Rejection, RejectionReason

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
BLACK = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32)


def run(frames, config=None, camera=CAMERA):
    tracker = RgbdOdometry(camera, config or Config())
    return [tracker.track(frame) for frame in frames]


def poses(tracked):
    """Return T_odom_cam per frame, as it was known then."""
    return np.array([each.T_odom_cam for each in tracked])


def errors(T_odom_cam, T_truth_cam):
    error = se3.inverse(T_truth_cam) @ T_odom_cam
    return se3.translation_norm(error), np.degrees(se3.rotation_angle(error))


def black(frame):
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))


def larger(frame, factor):
    return replace(frame, depth_m=np.float32(factor) * frame.depth_m)


def blind_beyond(frame, limit_m):
    return replace(frame, depth_m=np.where(frame.depth_m < limit_m, frame.depth_m, np.float32(0.0)))


@pytest.fixture(scope="module")
def tracked(frames):
    return run(frames)


def test_every_frame_of_a_good_recording_is_tracked_along_the_truth(tracked, T_first_cam):
    assert all(isinstance(each, TrackedFrame) for each in tracked)
    np.testing.assert_array_equal(tracked[0].T_kf_cam, np.eye(4))
    error_m, error_deg = errors(poses(tracked), T_first_cam)
    assert error_m.max() < 0.05 and error_deg.max() < 2.0
    assert se3.translation_norm(T_first_cam).max() > 0.5


def test_a_thing_that_is_followed_instead_of_the_room_covers_little_of_the_image(frames, tracked):
    paint = np.random.default_rng(0).integers(0, 255, (48, 16, 3), dtype=np.uint8)
    paint = paint.repeat(5, axis=0).repeat(5, axis=1)
    passing = []
    for i, frame in enumerate(frames):
        rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
        here = slice(10 * i % 240, 10 * i % 240 + 80)
        rgb[:, here], depth_m[:, here] = paint, 0.7
        passing.append(replace(frame, rgb=rgb, depth_m=depth_m))
    shares = [each.covered for each in run(passing) if isinstance(each, TrackedFrame)]
    assert np.median(shares[-20:]) < 0.5
    assert np.median([each.covered for each in tracked[1:]]) > 0.7


def test_the_first_frame_is_keyframe_0_at_the_origin(tracked, frames):
    first = tracked[0].new_keyframe
    assert first.id == tracked[0].keyframe_id == 0 and first.timestamp_s == frames[0].timestamp_s
    np.testing.assert_array_equal(first.T_odom_cam, np.eye(4))
    np.testing.assert_array_equal(tracked[0].T_kf_cam, np.eye(4))
    assert tracked[0].links == () and first.turning_rad_s == 0.0


def test_keyframes_count_up_and_carry_half_the_image(tracked):
    keyframes = [each.new_keyframe for each in tracked if each.new_keyframe]
    assert [keyframe.id for keyframe in keyframes] == list(range(len(keyframes)))
    assert 5 < len(keyframes) < 30
    assert {keyframe.preview.rgb.shape for keyframe in keyframes} == {(120, 160, 3)}
    assert len(keyframes[3].features.pixels) > 100


def test_keyframes_are_no_further_apart_than_one_frame_beyond_the_limits(tracked):
    keyframes = [each.new_keyframe for each in tracked if each.new_keyframe]
    for before, after in pairwise(keyframes):
        motion = se3.inverse(before.T_odom_cam) @ after.T_odom_cam
        assert se3.translation_norm(motion) < 0.2 + 0.12
        assert np.degrees(se3.rotation_angle(motion)) < 15.0 + 8.0


def test_links_lead_to_keyframes_that_see_the_same_and_fit_the_truth(tracked, frames, T_first_cam):
    index_of = {frame.timestamp_s: i for i, frame in enumerate(frames)}
    keyframes = [each.new_keyframe for each in tracked if each.new_keyframe]
    T_truth = [T_first_cam[index_of[keyframe.timestamp_s]] for keyframe in keyframes]
    for each in tracked[1:]:
        if each.new_keyframe is None:
            assert each.links == ()
            continue
        new_id = each.new_keyframe.id
        assert each.keyframe_id == new_id
        others = [link.ref_id for link in each.links]
        assert 1 <= len(set(others)) == len(others) <= 1 + OdometryConfig().links
        assert all(ref_id < new_id for ref_id in others)
        for link in each.links:
            assert link.query_id == new_id
            T_true = se3.inverse(T_truth[link.ref_id]) @ T_truth[new_id]
            error_m, error_deg = errors(link.motion.T_ref_query, T_true)
            assert error_m < 0.07 and error_deg < 2.0
    assert max(len(each.links) for each in tracked) > 1


def test_turning_is_measured_in_rad_per_second(tracked, frames, T_first_cam):
    times_s = np.array([frame.timestamp_s for frame in frames])
    turned = se3.rotation_angle(se3.inverse(T_first_cam[:-1]) @ T_first_cam[1:])
    truth_rad_s = dict(zip(times_s[1:], turned / np.diff(times_s), strict=True))
    keyframes = [each.new_keyframe for each in tracked[1:] if each.new_keyframe]
    measured = [keyframe.turning_rad_s for keyframe in keyframes]
    expected = [truth_rad_s[keyframe.timestamp_s] for keyframe in keyframes]
    np.testing.assert_allclose(measured, expected, atol=0.25)
    assert max(expected) > 0.4


def test_the_same_frames_give_the_same_bits(frames, tracked):
    again = run(frames[:20])
    np.testing.assert_array_equal(poses(again), poses(tracked[:20]))


@pytest.mark.parametrize("gap", [1, 3])
def test_black_frames_are_marked_and_those_after_them_tracked(frames, T_first_cam, gap):
    spoiled = frames[:20]
    spoiled[8 : 8 + gap] = [black(frame) for frame in spoiled[8 : 8 + gap]]
    tracked = run(spoiled)
    # From the second on, after a quarter of a second, it takes as much as for a loop.
    needed = [15, 20, 20][:gap]
    rejections = [Rejection(RejectionReason.FEW_MATCHES, 0, matches) for matches in needed]
    assert tracked[8 : 8 + gap] == rejections
    seen = [i for i in range(20) if not 8 <= i < 8 + gap]
    error_m, error_deg = errors(poses([tracked[i] for i in seen]), T_first_cam[seen])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_a_bent_image_is_straightened_with_care_for_its_time_stamps(frames):
    """Every other frame is stamped a millisecond after the one before, as if on arrival."""
    odometry, segments = RgbdOdometry(replace(CAMERA, readout_s=0.026), Config()), set()
    for i, frame in enumerate(frames[:20]):
        stamped_s = 0.06 * (i - 1) + 1e-3 if i % 2 else 0.06 * i
        tracked = odometry.track(replace(frame, timestamp_s=stamped_s))
        assert isinstance(tracked, TrackedFrame)
        segments.add(tracked.new_keyframe.segment if tracked.new_keyframe else 0)
    assert segments == {0}


def test_a_frame_that_follows_is_looked_for_nowhere_else_and_one_after_a_pause_everywhere(
    frames, monkeypatch
):
    tracker, asked = RgbdOdometry(CAMERA, Config()), []
    for owner, name in ((RgbdOdometry, "_follow"), (Trails, "relocalize")):
        monkeypatch.setattr(owner, name, _noting(getattr(owner, name), asked))
    tracker.track(frames[0])
    tracker.track(frames[1])
    assert asked == ["_follow"]
    tracker.track(replace(frames[2], timestamp_s=frames[1].timestamp_s + 5.0))
    assert asked == ["_follow", "relocalize"]


def _noting(method, names):
    def noting(*arguments):
        names.append(method.__name__)
        return method(*arguments)

    return noting


def test_it_is_told_why_the_landmarks_around_do_not_fit(frames, monkeypatch):
    tracker = RgbdOdometry(CAMERA, Config())
    tracker.track(frames[0])
    refusal = Rejection(RejectionReason.FEW_INLIERS, 3, 15)
    for module in ("odometry", "frame_pose"):
        monkeypatch.setattr(f"slam.tracking.{module}.track_local_map", lambda *_: refusal)
    monkeypatch.setattr(tracker, "_worth_a_segment", np.inf)
    assert tracker.track(frames[1]) == refusal


def test_a_blank_start_is_skipped_until_there_is_something_to_see(frames):
    tracked = run([black(frames[0]), black(frames[1]), *frames[2:5]])
    assert tracked[:2] == [Rejection(RejectionReason.FEW_MATCHES, 0, 15)] * 2
    first = tracked[2].new_keyframe
    assert first.id == 0 and first.timestamp_s == frames[2].timestamp_s
    np.testing.assert_array_equal(first.T_odom_cam, np.eye(4))
    assert all(isinstance(each, TrackedFrame) for each in tracked[2:])


def test_texture_without_depth_is_no_start(frames):
    blind = replace(frames[0], depth_m=np.zeros_like(frames[0].depth_m))
    assert run([blind]) == [Rejection(RejectionReason.FEW_MATCHES, 0, 15)]


def test_a_lost_camera_is_found_again_by_an_earlier_keyframe(frames, tracked, T_first_cam):
    # It is carried back to where it was three keyframes before, in one frame.
    count = next(i for i, each in enumerate(tracked) if each.new_keyframe and each.keyframe_id == 3)
    jump = replace(frames[1], timestamp_s=frames[count].timestamp_s + 0.1)
    found = run([*frames[: count + 1], jump])
    assert isinstance(found[-1], TrackedFrame)
    error_m, error_deg = errors(poses(found)[-1:], T_first_cam[1:2])
    assert error_m[0] < 0.05 and error_deg[0] < 2.0


def test_a_fast_turn_is_followed(frames, T_first_cam):
    every_third = list(range(0, 45, 3))
    found = run([frames[i] for i in every_third])
    assert all(isinstance(each, TrackedFrame) for each in found)
    error_m, error_deg = errors(poses(found), T_first_cam[every_third])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("keyframe_translation", 0.03),
        ("keyframe_rotation_deg", 3.0),
        ("keyframe_inlier_share", 0.9),
    ],
)
def test_each_setting_makes_more_keyframes(frames, tracked, setting, value):
    default = sum(each.new_keyframe is not None for each in tracked[:25])
    stricter = run(frames[:25], Config(odometry=OdometryConfig(**{setting: value})))
    assert sum(each.new_keyframe is not None for each in stricter) > default


@pytest.mark.parametrize("deg", [0.01, 3.0])
def test_keyframes_in_a_row_do_not_lose_what_the_adjustment_of_the_last_moves(
    frames, T_first_cam, deg
):
    crowded = run(frames[:25], Config(odometry=OdometryConfig(keyframe_rotation_deg=deg)))
    assert sum(each.new_keyframe is not None for each in crowded) > 5
    error_m, error_deg = errors(poses(crowded), T_first_cam[:25])
    assert error_m.max() < 0.02 and error_deg.max() < 1.0


@pytest.mark.parametrize("size", [0.25, 4.0, 16.0])
def test_a_larger_world_and_its_sensor_are_tracked_as_the_smaller_one_is(frames, tracked, size):
    camera = replace(CAMERA, depth_noise_m=CAMERA.depth_noise_m / size)
    found = run([larger(frame, size) for frame in frames[:20]], camera=camera)
    keyframes, expected = ([each.keyframe_id for each in some] for some in (found, tracked[:20]))
    assert keyframes == expected and max(keyframes) > 2
    T_odom_cam, T_expected = poses(found), poses(tracked[:20])
    T_odom_cam[:, :3, 3] /= size
    error_m, error_deg = errors(T_odom_cam, T_expected)
    assert error_m.max() < 0.001 and error_deg.max() < 0.05


def test_a_larger_world_is_tracked_where_nobody_says_how_noisy_its_depth_is(frames, T_first_cam):
    found = run([larger(frame, 4.0) for frame in frames])
    assert all(isinstance(each, TrackedFrame) for each in found)
    T_odom_cam = poses(found)
    T_odom_cam[:, :3, 3] /= 4.0
    error_m, error_deg = errors(T_odom_cam, T_first_cam)
    assert error_m.max() < 0.08 and error_deg.max() < 2.0


def test_what_is_beyond_the_range_of_depth_is_tracked_too(frames, T_first_cam):
    seen = [blind_beyond(frame, 1.8) for frame in frames]
    assert np.median([(frame.depth_m > 0.0).mean() for frame in seen]) < 0.45
    found = run(seen)
    assert all(isinstance(each, TrackedFrame) for each in found)
    assert {each.new_keyframe.segment for each in found if each.new_keyframe} == {0}
    error_m, error_deg = errors(poses(found), T_first_cam)
    assert error_m.max() < 0.15 and error_deg.max() < 4.0


def test_no_more_links_than_asked_for(frames):
    config = OdometryConfig(links=0, keyframe_translation=0.03)
    tracked = run(frames[:15], Config(odometry=config))
    links = [each.links for each in tracked if each.new_keyframe]
    assert len(links) > 3
    assert [len(each) for each in links] == [0] + [1] * (len(links) - 1)


def test_how_the_camera_came_to_a_keyframe_is_measured_whoever_shares_more(frames, monkeypatch):
    covisible = Trails.covisible
    monkeypatch.setattr(Trails, "covisible", lambda *arguments: covisible(*arguments)[::-1])
    reference = None
    for each in run(frames, Config(odometry=OdometryConfig(links=0))):
        if each.new_keyframe and reference is not None:
            assert reference in [link.ref_id for link in each.links]
        reference = each.keyframe_id


def test_a_link_knows_how_far_off_it_may_be(tracked, frames, T_first_cam):
    """The squared errors, in units of their covariance, have about the median of chi-square."""
    index_of = {frame.timestamp_s: i for i, frame in enumerate(frames)}
    keyframes = [each.new_keyframe for each in tracked if each.new_keyframe]
    T_truth = [T_first_cam[index_of[keyframe.timestamp_s]] for keyframe in keyframes]
    squared = []
    for link in (link for each in tracked for link in each.links):
        T_true = se3.inverse(T_truth[link.ref_id]) @ T_truth[link.query_id]
        error = se3.log(se3.inverse(link.motion.T_ref_query) @ T_true)
        squared.append(error @ link.motion.information @ error)
    assert len(squared) > 20 and 2.0 < np.median(squared) < 12.0  # 5.35 of many


def test_a_link_is_vaguer_where_a_rolling_shutter_turned_fast(frames):
    sigmas_m = []
    for camera in (CAMERA, replace(CAMERA, readout_s=0.02)):
        tracker = RgbdOdometry(camera, Config())
        tracked = [tracker.track(frame) for frame in frames[:20]]
        (link, *_) = [link for each in tracked for link in each.links]
        sigmas_m.append(translation_sigma_m(link.motion))
    assert sigmas_m[1] > 1.5 * sigmas_m[0]


def test_the_map_holds_the_keyframes_and_landmarks_that_several_of_them_see(frames):
    tracker = RgbdOdometry(CAMERA, Config())
    keyframes = [tracker.track(frame).new_keyframe for frame in frames[:30]]
    ids = [keyframe.id for keyframe in keyframes if keyframe]
    assert len(tracker.map.keyframes) == len(ids)
    shared = [len(tracker.map.shared_features(a, b)) for a, b in pairwise(ids)]
    assert min(shared) > 30


def test_standing_still_makes_no_keyframes(frames):
    still = [replace(frames[0], timestamp_s=float(i)) for i in range(6)]
    tracked = run(still)
    assert [each.new_keyframe is not None for each in tracked] == [True] + [False] * 5
    np.testing.assert_allclose(poses(tracked), np.tile(np.eye(4), (6, 1, 1)), atol=1e-6)


def noise(frame):
    """Return a frame with depth that shows nothing that any other does."""
    rng = np.random.default_rng(round(1000 * frame.timestamp_s))
    coarse = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    rgb = np.kron(coarse, np.ones((10, 10, 1), dtype=np.uint8))
    return replace(frame, rgb=rgb, depth_m=np.full_like(frame.depth_m, 2.0))


@pytest.fixture(scope="module")
def torn(frames):
    """Return what becomes of a camera that is carried across the room with its lens covered."""
    spoiled = [*frames[:8], *(black(frame) for frame in frames[8:11]), *frames[24:34]]
    return spoiled, run(spoiled)


def test_a_camera_in_an_unknown_place_begins_a_segment_of_its_own_at_once(torn, T_first_cam):
    _, tracked = torn
    assert all(isinstance(each, Rejection) for each in tracked[8:11])
    assert all(isinstance(each, TrackedFrame) for each in tracked[11:])
    begun = tracked[11].new_keyframe
    assert begun.segment == 1 and begun.turning_rad_s == 0.0 and tracked[11].links == ()
    assert begun.id == tracked[11].keyframe_id == 1 + max(each.keyframe_id for each in tracked[:8])
    np.testing.assert_array_equal(begun.T_odom_cam, np.eye(4))
    T_begun_cam = se3.inverse(T_first_cam[24]) @ T_first_cam[24:34]
    error_m, error_deg = errors(poses(tracked[11:]), T_begun_cam)
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_links_stay_within_their_segment(torn):
    _, tracked = torn
    keyframes = [each.new_keyframe for each in tracked if getattr(each, "new_keyframe", None)]
    segment_of = {keyframe.id: keyframe.segment for keyframe in keyframes}
    assert list(segment_of) == list(range(len(keyframes)))
    assert sorted(segment_of.values()) == list(segment_of.values())
    links = [link for each in tracked[:8] + tracked[11:] for link in each.links]
    assert all(segment_of[link.ref_id] == segment_of[link.query_id] for link in links)


def test_the_origin_of_a_later_segment_stays_where_it_is(frames):
    tracker = RgbdOdometry(CAMERA, Config())
    for frame in [*frames[:8], *frames[24:50]]:
        tracker.track(frame)
    origins = [
        each.T_map_cam for each in tracker.map.keyframes if (each.T_map_cam == np.eye(4)).all()
    ]
    assert len(origins) == 2


def test_a_single_bad_frame_does_not_part_the_map(frames, tracked, T_first_cam):
    spoiled = [noise(frame) if i in (8, 13, 14) else frame for i, frame in enumerate(frames[:20])]
    found = run(spoiled)
    seen = [i for i in range(20) if i not in (8, 13, 14)]
    of_frame = segment_of_each(found)
    assert {of_frame[i] for i in seen} == {0}
    assert len({of_frame[i] for i in (8, 13, 14)} | {0}) == 4
    error_m, error_deg = errors(poses(found)[seen], T_first_cam[seen])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def segment_of_each(tracked):
    """Return the segment of every frame: that of the keyframe it was placed against."""
    segment_of, found = {}, []
    for each in tracked:
        if each.new_keyframe is not None:
            segment_of[each.new_keyframe.id] = each.new_keyframe.segment
        found.append(segment_of[each.new_keyframe.id if each.new_keyframe else each.keyframe_id])
    return found


def test_a_frame_that_shows_next_to_nothing_is_not_worth_a_segment(frames):
    dim = noise(frames[6])
    dim.depth_m[:, 40:] = 0.0
    tracked = run([*frames[:6], dim, *frames[7:9]])
    assert isinstance(tracked[6], Rejection) and tracked[6].needed == 15
    assert segment_of_each([*tracked[:6], *tracked[7:]]) == [0] * 8
    (begun,) = run([dim])  # but better than no beginning
    assert begun.new_keyframe.segment == 0 and len(begun.new_keyframe.features.pixels) > 15


def test_many_bad_frames_in_a_row_do_not_hide_where_the_camera_was(frames, T_first_cam):
    found = run([noise(frame) if 8 <= i < 11 else frame for i, frame in enumerate(frames[:20])])
    seen = [i for i in range(20) if not 8 <= i < 11]
    of_frame = segment_of_each(found)
    assert {of_frame[i] for i in seen} == {0} and of_frame[8:11] == [1, 2, 3]
    error_m, error_deg = errors(poses(found)[seen], T_first_cam[seen])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_a_camera_that_comes_back_goes_on_where_it_was(frames, T_first_cam):
    # Far away for some frames, and then back: the last two segments are remembered.
    away = [
        replace(frame, timestamp_s=frames[7].timestamp_s + 0.1 * i)
        for i, frame in enumerate(frames[24:30], start=1)
    ]
    back = [
        replace(frame, timestamp_s=away[-1].timestamp_s + 0.1 * i)
        for i, frame in enumerate(frames[7:14], start=1)
    ]
    found = run([*frames[:8], *away, *back])
    assert segment_of_each(found) == [0] * 8 + [1] * 6 + [0] * 7
    assert found[14].new_keyframe is not None and found[14].links[0].ref_id < found[8].keyframe_id
    error_m, error_deg = errors(poses(found)[14:], T_first_cam[7:14])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_a_session_begins_anew_even_where_the_last_one_ended(frames):
    tracker = RgbdOdometry(CAMERA, Config())
    for frame in frames[:5]:
        tracker.track(frame)
    tracker.start_session()
    assert isinstance(tracker.track(black(frames[5])), Rejection)
    begun = tracker.track(frames[6]).new_keyframe
    assert begun.segment == 1
    np.testing.assert_array_equal(begun.T_odom_cam, np.eye(4))


@pytest.fixture(scope="module")
def uncovered(frames):
    """Return a drive there, three seconds in the dark, and frames of the way back near the start.

    The frames are stamped anew, and images of the way back are others than those of the way there.
    """
    out, back = frames[:26], frames[49:58]
    return [*out, *dark(out[-1].timestamp_s), *after(out[-1].timestamp_s + 3.0, back)]


def after(last_s, some):
    return [replace(frame, timestamp_s=last_s + i / 7.5) for i, frame in enumerate(some, start=1)]


def dark(last_s):
    return [Frame(last_s + i / 7.5, *BLACK) for i in range(1, 22)]


class Memory:
    """Recognizes what it is told to, from some time on, and notes which segment was not wanted."""

    def __init__(self, *keyframe_ids, from_time=1):
        self.keyframe_ids, self.from_time, self.asked = keyframe_ids, from_time, []

    def __call__(self, rgb, but_segment):
        assert rgb.shape == (240, 320, 3)
        self.asked.append(but_segment)
        return self.keyframe_ids if len(self.asked) >= self.from_time else ()


def run_with(memory, frames):
    closer = OdometryConfig(keyframe_translation=0.1)
    odometry = RgbdOdometry(CAMERA, Config(odometry=closer), memory)
    return [odometry.track(frame) for frame in frames]


def test_a_lost_camera_is_placed_wherever_it_is_recognized(uncovered, T_first_cam):
    memory = Memory(6, 2)  # the first looks like it, but is another place
    found = run_with(memory, uncovered)
    assert memory.asked == [None]  # frames that follow or show nothing are not looked up
    assert all(isinstance(each, Rejection) for each in found[26:47])
    assert segment_of_each([*found[:26], *found[47:]]) == [0] * 35
    placed = found[47]
    assert placed.new_keyframe is not None
    assert placed.links[0].ref_id == 2 and len(placed.links) > 1
    assert max(link.ref_id for link in placed.links) < 6
    error_m, error_deg = errors(poses([*found[:26], *found[47:]])[26:], T_first_cam[49:58])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_who_is_not_recognized_or_not_where_he_seems_to_be_begins_a_segment(uncovered):
    for memory in (Memory(), Memory(6)):
        found = run_with(memory, uncovered)
        assert segment_of_each([*found[:26], *found[47:]]) == [0] * 26 + [1] * 9
        assert found[47].links == ()
        assert memory.asked == [None] + 4 * [1]  # again after 1, 2, 4 and 8 frames


def test_who_is_recognized_a_little_later_goes_on_where_that_is(uncovered, T_first_cam):
    memory = Memory(2, from_time=3)
    found = run_with(memory, uncovered)
    placed = [*found[:26], *found[47:]]
    assert segment_of_each(placed) == [0] * 26 + [1, 1] + [0] * 7
    assert memory.asked == [None, 1, 1]
    error_m, error_deg = errors(poses(placed)[28:], T_first_cam[51:58])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0


def test_a_camera_that_is_back_in_another_part_of_its_segment_looks_around_anew(
    uncovered, T_first_cam
):
    last_s = uncovered[-1].timestamp_s
    away = after(last_s + 3.0, uncovered[23:26])  # as near its keyframe as can be
    found = run_with(Memory(2), [*uncovered, *dark(last_s), *away])
    assert found[-3].new_keyframe is not None
    placed = [each for each in found if isinstance(each, TrackedFrame)]
    assert segment_of_each(placed) == [0] * 38
    error_m, error_deg = errors(poses(placed)[-3:], T_first_cam[23:26])
    assert error_m.max() < 0.05 and error_deg.max() < 2.0
