# SPDX-License-Identifier: Apache-2.0
"""Every setting, one frozen section per stage: defaults, allowed ranges and help texts.

The TOML file, the command-line flags and the settings shown in the report all come from here.
"""

import json
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    field_validator,
)

from placerec.files import read_toml
from slam.types import SlamError

PYRAMID_SCALE = 1.2
"""Ratio between neighbouring pyramid levels; a feature's pixel noise grows with it."""

PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(gt=0, le=1_000_000)]
DepthScale = Annotated[float, Field(ge=1e-6, le=1e9)]
"""Depth image units per metre."""
_Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
_Name = TypeVar("_Name", Path, str)
_SevenNumbers = tuple[float, float, float, float, float, float, float]


def _in_unicode(value: _Name) -> _Name:
    """Refuse what no settings file could hold, such as a file's name in another encoding."""
    try:
        str(value).encode()
    except UnicodeEncodeError as error:
        raise ValueError("the name is not in UTF-8; rename it") from error
    return value


class _Section(BaseModel):
    """A group of settings that cannot change during a run and refuses unknown names."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


_File = Annotated[Path, AfterValidator(_in_unicode), AfterValidator(Path.absolute)]
_Topic = Annotated[str, AfterValidator(_in_unicode)]


class InputConfig(_Section):
    """How a sequence is read."""

    camera: Annotated[Path, AfterValidator(_in_unicode), AfterValidator(Path.absolute)] | None = (
        None
    )
    """TOML file of the camera; default: camera.toml of the folder, else what its format tells."""
    depth_scale: DepthScale | None = None
    """Depth image units per metre; overrides the camera's."""
    max_time_difference_s: PositiveFloat = 0.02
    """Colour and depth images of a TUM folder or a bag further apart than this are not paired."""
    color_topic: _Topic | None = None
    """Topic of a bag's colour images; default: the only one that holds some."""
    depth_topic: _Topic | None = None
    """Topic of a bag's depth images; default: the only one, or the one registered to colour."""
    camera_info_topic: _Topic | None = None
    """Topic of the colour camera's calibration in a bag; default: the one beside the images."""
    odometry_topic: _Topic | None = None
    """Topic of a bag's poses by another odometry; default: the only one that holds some."""


class FeaturesConfig(_Section):
    """ORB extraction and matching."""

    count: Annotated[int, Field(gt=0, le=100_000)] = 1000
    """Features wanted per image."""
    levels: Annotated[int, Field(ge=1, le=16)] = 8
    """Pyramid levels, each 1.2 times smaller than the one before."""
    fast_threshold: Annotated[int, Field(ge=1, le=255)] = 12
    """Smallest brightness step of a corner; lower finds more corners in blurred images."""


class VerificationConfig(_Section):
    """When geometry believes that two views show the same place."""

    min_matches: PositiveInt = 20
    """Descriptor matches with depth needed before a pose is tried."""
    min_inliers: PositiveInt = 25
    """Matches that must agree with one rigid motion."""
    min_inlier_ratio: _Fraction = 0.25
    """Share of the matches that must agree."""
    min_support: _Fraction = 0.04
    """Share of the image that the inliers' bounding box must cover."""
    max_uncertainty: PositiveFloat = 0.2
    """Largest standard deviation of a loop's translation, as a share of the depth of what is seen:
    it says next to nothing beyond. Below, the pose graph weighs the loop by it."""
    max_descriptor_distance: Annotated[int, Field(ge=1, le=256)] = 64
    """Largest Hamming distance of two matching descriptors."""
    max_reprojection_px: PositiveFloat = 3.0
    """Largest error of an inlier on the finest pyramid level; more on coarser ones."""
    ransac_iterations: Annotated[int, Field(gt=0, le=100_000)] = 300
    """Trials of PnP RANSAC."""


class OdometryConfig(_Section):
    """Tracking, when a frame becomes a keyframe, and how poses from elsewhere are to be read."""

    min_inliers: PositiveInt = 15
    """Matches that must agree with the motion, else the frame counts as not tracked."""
    keyframe_translation: PositiveFloat = 0.15
    """A camera this far from its keyframe starts a new one; the unit is the median depth of what is
    seen."""
    keyframe_rotation_deg: PositiveFloat = 15.0
    """A camera turned this much against its keyframe starts a new one."""
    keyframe_inlier_share: _Fraction = 0.35
    """A new keyframe starts when fewer than this share of the keyframe's features is tracked."""
    links: Annotated[int, Field(ge=0, le=1000)] = 4
    """Keyframes that a new one is tied to by what both see, besides the one that shares most and
    the one that the camera came from."""
    T_base_cam: Literal["auto"] | _SevenNumbers | None = None
    """Where the camera's optical frame (x right, y down, z ahead) is on the body that given poses
    are of: tx ty tz qx qy qz qw, metres; auto: as the images tell; default: they are the camera's.
    """
    scale: Literal["auto"] | PositiveFloat = 1.0
    """Metres per unit of given poses; auto: as the depth images tell."""
    time_offset_s: Literal["auto"] | FiniteFloat = 0.0
    """How much later the time stamps of given poses are than the images'; auto: as turning tells.
    """
    inverted: bool = False
    """Given poses take the world to the camera, as extrinsics do."""
    w_first: bool = False
    """Given quaternions are w x y z."""

    @field_validator("T_base_cam")
    @classmethod
    def _has_a_rotation(cls, value: object) -> object:
        if isinstance(value, tuple) and sum(q * q for q in value[3:]) < 1e-6:
            raise ValueError("the quaternion qx qy qz qw has length zero")
        return value


class KeyframesConfig(_Section):
    """What is kept of keyframes until the outputs are made."""

    memory_mb: Annotated[int, Field(ge=0, le=1_000_000)] = 64
    """Images and features of keyframes, some 120 kB each at 640x480, that do not fit into so many
    MB go to a temporary file beside the outputs."""


class LoopConfig(_Section):
    """Which earlier keyframes are looked at as the same place."""

    min_gap: PositiveInt = 5
    """Keyframes of one segment that fewer than so many were taken after are not candidates."""
    candidates: Annotated[int, Field(gt=0, le=1000)] = 4
    """Keyframes verified by geometry, per new keyframe."""
    second_look: Annotated[int, Field(ge=0, le=1000)] = 0
    """Of so many most similar keyframes, 10 for example, a second look, cheaper than geometry,
    chooses those to verify; 0: the most similar ones are verified."""
    min_similarity: Literal["adapted"] | Annotated[float, Field(ge=-1.0, le=1.0)] | None = None
    """Cosine from which a candidate is verified; adapted: the recognizer's own threshold at first,
    then where the images of this run ask for it; default: the recognizer's own."""
    recognizer_limit_s: PositiveFloat = 60.0
    """A recognizer that takes longer than this for one answer is given up."""


class GraphConfig(_Section):
    """The robust pose graph."""

    inlier_probability: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.95
    """Share of the true loops to keep if their noise is what they claim; a loop with a larger error
    is outvoted. More keeps more true loops, and more false ones that fit by chance."""


class MotionConfig(_Section):
    """How the camera moved between its frames."""

    smooth: bool = False
    """Smooth all frames once they are placed, as far as the run itself shows that it helps."""


class EvaluationConfig(_Section):
    """Comparison with ground truth."""

    max_time_difference_s: PositiveFloat = 0.02
    """Estimated and true poses further apart than this are not compared."""
    rpe_interval_s: PositiveFloat = 1.0
    """Interval over which the relative pose error is measured."""
    false_loop_translation_m: PositiveFloat = 0.10
    """An accepted loop whose motion is off by more than this is called false."""
    false_loop_rotation_deg: PositiveFloat = 5.0
    """An accepted loop whose motion is off by more than this is called false."""


class MapConfig(_Section):
    """The fused point cloud of the corrected keyframes, and meshes before and after."""

    write: bool = True
    """Write map.ply."""
    mesh: bool = False
    """Write mesh_before.ply and mesh_after.ply, along the odometry and along the corrected path."""
    voxel_m: Annotated[float, Field(ge=1e-4, allow_inf_nan=False)] | None = None
    """Edge of the grid cells that depth is merged in; default: 1/150 of the median depth."""
    max_depth_m: PositiveFloat | None = None
    """Depth beyond this is left out; default: 2.5 times the median depth."""


class Config(_Section):
    """All settings of a run."""

    input: InputConfig = InputConfig()
    features: FeaturesConfig = FeaturesConfig()
    odometry: OdometryConfig = OdometryConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    loop: LoopConfig = LoopConfig()
    verification: VerificationConfig = VerificationConfig()
    graph: GraphConfig = GraphConfig()
    motion: MotionConfig = MotionConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    map: MapConfig = MapConfig()


SECTIONS = {type(section).__name__: name for name, section in Config()}
"""What stands before the dot of a setting's flag, by the name of the class that it is in."""


def load_config(path: Path) -> Config:
    """Read settings from a TOML file whose tables are the sections.

    Raises:
        SlamError: the file is missing, is not TOML, or holds a value that is not allowed.
    """
    values = read_toml(path, what="the settings file", kind=SlamError)
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise SlamError(f"{_describe(error)}: {path}") from error


def _describe(error: ValidationError) -> str:
    """Return the first problem of a validation as one line: setting, value, what is allowed."""
    first = error.errors()[0]
    # What comes after section and setting names one of several kinds of value.
    name = ".".join(str(part) for part in first["loc"][:2])
    if first["type"] == "extra_forbidden":
        close = get_close_matches(name, _names(), 1)
        hint = f"did you mean {close[0]}? " if close else ""
        return f"there is no setting {name}; {hint}`run_slam --help-all` lists them all"
    of_the_same = [each["msg"] for each in error.errors() if each["loc"][:2] == first["loc"][:2]]
    return f"setting {name} = {first['input']!r}: {' or '.join(of_the_same)}"


def _names() -> list[str]:
    return [f"{section}.{name}" for section, values in Config() for name, _ in values]


def to_toml(config: Config) -> str:
    """Return the settings as TOML that `load_config` reads back; unset ones are left out."""
    lines: list[str] = []
    for section, values in config.model_dump(mode="json", exclude_none=True).items():
        settings = [f"{name} = {_toml(value)}" for name, value in values.items()]
        lines += [f"[{section}]", *settings, ""]
    return "\n".join(lines)


def _toml(value: object) -> str:
    """Return a value as TOML: as JSON, but for characters of which JSON makes two escapes."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
