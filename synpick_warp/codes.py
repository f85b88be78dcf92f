"""Integer enumerations shared by device arrays, host code and files, and limits shared by them. Imports nothing else of the project.

Warp resolves members of an `IntEnum` in kernels, so device code, stages and exporters name the same member. The members of a
`_Described` enum carry a sentence for people.
"""

import enum
import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Self

MAX_CUPS = 16
"""Most suction cups of a gripper: the bits of a word that says which of them hold an instance."""
MASK_ROWS = 32
"""Rows of an image column that a word of an amodal mask covers, the first in its lowest bit."""
MAX_DISPARITIES = 256
"""Largest number of disparities that stereo matching searches, from the smallest on [px]; a multiple of the 32 threads of a warp."""


class _Described(enum.IntEnum):
    """Enum declared by sentences; the value of a member is its position in that order."""

    sentence: str

    def __new__(cls, sentence: str) -> Self:
        member = int.__new__(cls, len(cls.__members__))
        member._value_ = len(cls.__members__)
        member.sentence = sentence
        return member


class Phase(enum.IntEnum):
    """Phase of a world: from no episode, by drop, settling and action, to none left."""

    EMPTY = 0
    """No episode assigned yet."""
    START = 1
    """An episode is assigned; its objects are sampled and dropped in this tick."""
    SETTLE = 2
    """Dropped objects fall until they are at rest."""
    ACT = 3
    """The gripper moves or picks; every tick is a frame."""
    OVER = 4
    """The episode ended in this tick, with an `Ending`."""
    IDLE = 5
    """No episode is left to assign."""


class Mode(enum.IntEnum):
    """Mode of an episode: behaviour of the gripper in phase ACT."""

    MOVE = 0
    """Stirring: the gripper visits the corners of the tote."""
    PICK = 1
    """Untargeted picking: the target has the fewest ancestors in the clutter graph."""
    TARGET = 2
    """Targeted picking: the target has the most ancestors."""
    STILL = 3
    """One frame of the settled pile; the gripper waits, and is invisible."""


class Task(enum.IntEnum):
    """Task of the gripper in phase ACT of the modes PICK and TARGET. Their order is the order of an attempt."""

    NONE = 0
    LOOK = 1
    """The gripper waits beside the tote; perception plans a target and a grasp at the end of the tick."""
    APPROACH = 2
    """The setpoint moves from far above to a short distance before the grasp point."""
    DESCEND = 3
    """The setpoint moves along the surface normal to the grasp point."""
    PRESS = 4
    """The setpoint rests at the grasp point until the cup is at rest; suction is switched on at the end of the last tick."""
    LIFT = 5
    """The setpoint moves up; attached objects are judged at the end of the tick in which it arrives."""


class Removal(enum.IntEnum):
    """Why an instance has left the scene."""

    NONE = 0
    PICKED = 1
    LOST = 2


class Lost(enum.IntEnum):
    """Bits of what collision detection had no room for."""

    PAIRS = 1
    CONTACTS = 2


class Ending(_Described):
    """Why an episode stopped. The endings that deliver are consecutive; device code relies on it."""

    RUNNING = "the episode is still running"
    FINISHED = "the gripper has been everywhere it was to go"
    EMPTIED = "no object is left in the tote"
    GAVE_UP = "too many attempts have failed"
    UNSETTLED = "the objects did not come to rest in time, or were dropped again too often, so the arrangement was resampled"
    ARRANGEMENT_OVERFLOW = "more objects of a kind were drawn than a world has body slots for, so the arrangement was resampled"
    SOLVER_OVERFLOW = "more constraint rows arose than the solver has capacity for, so the episode was resampled"
    NOT_FINITE = "a pose became infinite or not a number, so the episode was resampled"
    PERCEPTION_OVERFLOW = "a contour has more points than its capacity, so the episode was resampled"
    CONTACT_OVERFLOW = "more contacts arose than the worlds have capacity for, so the episode was resampled"
    PAIR_OVERFLOW = "more pairs of shapes came near each other than the worlds have capacity for, so the episode was resampled"

    @property
    def delivers(self) -> bool:
        """True if an episode with this ending becomes part of the data set."""
        return Ending.FINISHED <= self <= Ending.GAVE_UP


class Outcome(_Described):
    """Result of an attempt to pick. The failures come last; device code relies on it."""

    NONE = "no attempt has ended"
    TARGET_PICKED = "the target hung on the cup after the lift"
    OTHER_PICKED = "another object than the target hung on the cup after the lift"
    DROPPED = "every seal broke during the lift"
    NOTHING_CAUGHT = "no ray of the cup hit an object"
    NOTHING_SEEN = "no object in the tote is visible"

    @property
    def succeeded(self) -> bool:
        """True if an object was picked."""
        return self in (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)


class Share(enum.IntEnum):
    """Share of the grasp candidates of a state to which one belongs: how it was sampled."""

    OWN = 0
    """The grasp that the episode itself executes from the state."""
    STRATIFIED = 1
    """Stratified over visible instances and analytic scores, so that failures are present."""
    UNIFORM = 2
    """Uniform over the visible pixels of all instances."""


class Status(enum.IntEnum):
    """Column of a world's status row: integers that the host reads after each tick.

    The row describes the end of the tick, before perception runs: attempt, target, hits and seals belong to the running
    attempt, or in a tick with an outcome to the attempt that ended. Reports and data sets call the columns by `column_names`.
    """

    PHASE = 0
    ENDING = 1
    EPISODE = 2
    ARRANGEMENT = 3
    """Index of the arrangement within its episode: 0, plus 1 each time it was resampled."""
    FRAME = 4
    LIVE = 5
    MODE = 6
    TASK = 7
    ATTEMPT = 8
    OUTCOME = 9
    TARGET = 10
    HITS = 11
    SEALED = 12
    """Bit k: cup k has a good seal, if suction was switched on."""


class Measure(enum.IntEnum):
    """Column of a world's row of real numbers that the host reads after each tick."""

    PEAK_FORCE = 0
    """Largest seal force in the tick [N], that of a seal that broke included."""
    BREAK_FORCE = 1
    """Least break force of the cups that have something below them, with `suction.vacuum` [N]; 0: none."""


class Stream(enum.IntEnum):
    """Random number stream: part of the key of `kernels.rng.stream_key`, so that samples for different purposes are independent."""

    OBJECTS = 1
    DROP = 2
    REDROP = 3
    CORNERS = 4
    LIGHT = 5
    MODE = 6
    TARGETS = 7
    PATHS = 8
    EFFECTS = 9
    COLOR_NOISE = 10
    DEPTH_NOISE = 11
    BIN = 12
    LOOKS = 13
    DISTRACTORS = 14
    COMPARTMENT = 15
    INFRARED_NOISE = 16
    CAMERA = 17
    GRASPS = 18
    CANDIDATES = 19
    TRIALS = 20
    UPRIGHT = 21
    SCATTER = 22
    DOME = 23
    CLEAR = 24


class Look(enum.IntEnum):
    """Parameter that is drawn, of a body, the table, a lamp or the episode; see `configs.episodes.randomize`."""

    HUE = 0
    """Rotation of the hue [°]."""
    BRIGHTNESS = 1
    """Factor on the base colour."""
    ROUGHNESS = 2
    METALLIC = 3
    COLOR = 4
    """Base colour [sRGB]."""
    TEXTURE = 5
    """Index of a texture."""
    TEXTURE_WIDTH = 6
    """Width of one repeat of the texture [m]."""
    COUNT = 7
    """Number of lamps, or of the episode's distractors."""
    ELEVATION = 8
    """Height of a lamp above the horizon [°]."""
    RADIUS = 9
    """Angular radius of a lamp [°]."""
    STRENGTH = 10
    """Irradiance of a surface that faces up by a lamp, relative to that by the map."""
    TEMPERATURE = 11
    """Colour temperature of a lamp [K]."""
    AZIMUTH = 12
    """Azimuth of a lamp in the map [°]."""
    EXPOSURE = 13
    """Exposure compensation [EV]."""
    SCRATCHES = 14
    """Amount of scratches, 0 to 1; this and the next three are the components of `kernels.render.lighting.wear`."""
    RUST = 15
    """Fraction of the surface that is rusty."""
    STAINS = 16
    """Fraction of the surface that is oily."""
    DUST = 17
    """Density of dust, 0 to 1."""
    TRANSMISSION = 18
    """Fraction of the light that passes through."""
    LABEL = 19
    """Width of a label [m]."""


class LookPart(enum.IntEnum):
    """Part of a scene that has such parameters."""

    OBJECT = 0
    BIN = 1
    TABLE = 2
    LAMP = 3
    EPISODE = 4
    """The episode as a whole."""
    BACKGROUND = 5
    """Floor that is seen beyond the edge of the table."""


class LookKind(enum.IntEnum):
    """Kind of a probability distribution; see `configs.episodes.randomize.Distribution`."""

    OFF = 0
    FIXED = 1
    UNIFORM = 2
    LOG_UNIFORM = 3
    NORMAL = 4
    CHOICE = 5


class Segment(enum.IntEnum):
    """Segmentation id of a pixel that shows no instance; instances are 1 + instance_id."""

    NOTHING = 0
    TABLE = 252
    TOTE = 253
    FINGER = 254
    CUP = 255


MAX_INSTANCES = int(Segment.TABLE) - 1
"""Most instances of a world: segmentation ids that are left beside those of `Segment`."""
SHAFT = 1
"""Column of the gripper's shaft in the poses of fixtures: after the bin, before the cups."""


class Tone(enum.IntEnum):
    """Tone curve of the camera: shoulder, linear or filmic."""

    SHOULDER = 0
    """Linear up to 0.6, highlights compressed."""
    LINEAR = 1
    """Clipped at 1."""
    FILMIC = 2
    """ACES' filmic curve, middle grey kept."""


class Effect(enum.IntEnum):
    """Parameter of the camera effects of a view; the first three in EV."""

    EXPOSURE = 0
    RED = 1
    BLUE = 2
    VIGNETTE = 3
    CHROMATIC_ABERRATION = 4
    BLUR = 5
    SHOT_NOISE = 6
    READ_NOISE = 7
    JPEG_QUALITY = 8
    CONTRAST = 9
    SATURATION = 10


@functools.cache
def column_names(kind: type[enum.IntEnum]) -> Mapping[str, enum.IntEnum]:
    """Members of `Status` or `Measure` by their name in reports and data sets, in order of their values."""
    return MappingProxyType({member.name.lower(): member for member in sorted(kind)})


@functools.cache
def names(kind: type[enum.IntEnum]) -> tuple[str, ...]:
    """Lower-case names of an enum's members, in order of their values."""
    return tuple(member.name.lower() for member in sorted(kind))
