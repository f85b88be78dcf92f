"""Domain randomization settings (Tobin et al., IROS 2017): probability distributions of what each episode looks like."""

import bisect
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

from synpick_warp.codes import LookKind, names
from synpick_warp.configs.fields import setting

OFF, FIXED, UNIFORM, LOG_UNIFORM, NORMAL, CHOICE = KINDS = names(LookKind)
"""Kinds of distributions."""
_WEIGHTS = "weights"
_LIMITS = (LOG_UNIFORM, UNIFORM)
_PAIRS = (*_LIMITS, NORMAL)
MOST_DISTRACTORS = 16
"""Maximum number of distractors: half of the instances that a world may have."""
NORMAL_REACH = 3.0
"""Standard deviations at which `Distribution.sample` cuts a normal distribution, whose range can then be checked."""
MOST_CHOICES = 256
"""Maximum number of values of a choice."""


@dataclass(frozen=True)
class Distribution:
    """Probability distribution of a scalar; subclasses draw vectors with independent components.

    In TOML: a value (`0.5`), "off", or a table of one kind: `{ uniform = [low, high] }`, `{ log_uniform = [low, high] }`,
    `{ normal = [mean, sigma] }`, clamped to the setting's range, or `{ choice = [value, ...], weights = [...] }`.
    """

    kind: str = OFF
    values: tuple[tuple[float, ...], ...] = ()
    """Parameters of the kind: the value, low and high, mean and standard deviation, or the choices; each with all components."""
    weights: tuple[float, ...] = ()
    """Of a choice: the relative weight of each value; empty: equal."""

    components: ClassVar[int] = 1
    noun: ClassVar[str] = "number"

    @classmethod
    def parse(cls, value: object) -> Self:
        """Distribution of a TOML value. Raises ValueError: it is none."""
        if value == OFF:
            return cls()
        if isinstance(value, Distribution):
            return cls(value.kind, value.values, value.weights)
        if not isinstance(value, Mapping):
            return cls(FIXED, (cls._components(value),))
        kind, *others = [key for key in value if key != _WEIGHTS] or [""]
        if others or kind not in (*_PAIRS, CHOICE):
            raise ValueError(cls.describe())
        given = value[kind]
        if not isinstance(given, list | tuple) or (kind in _PAIRS and len(given) != 2) or not 0 < len(given) <= MOST_CHOICES:
            raise ValueError(f"{kind} = a list of {'2' if kind in _PAIRS else f'1 to {MOST_CHOICES}'}")
        values = tuple(cls._components(one) for one in given)
        if kind in _LIMITS and any(low > high for low, high in zip(*values, strict=True)):
            raise ValueError(f"{kind} = [low, high] with low at most high")
        if kind == LOG_UNIFORM and min(values[0]) <= 0.0:
            raise ValueError("log_uniform = [low, high] above 0")
        if kind == NORMAL and min(values[1]) < 0.0:
            raise ValueError("normal = [mean, sigma] with sigma at least 0")
        return cls(kind, values, cls._weights(value, kind, len(values)))

    @staticmethod
    def _weights(table: Mapping[str, Any], kind: str, count: int) -> tuple[float, ...]:
        if _WEIGHTS not in table:
            return ()
        weights = table[_WEIGHTS]
        if kind != CHOICE or not isinstance(weights, list | tuple) or len(weights) != count:
            raise ValueError("weights for a choice, one for each value")
        numbers = tuple(_number(weight) for weight in weights)
        if min(numbers) < 0.0 or not 0.0 < sum(numbers) < math.inf:
            raise ValueError("weights of at least 0, not all 0")
        return numbers

    @classmethod
    def _components(cls, value: object) -> tuple[float, ...]:
        if cls.components == 1:
            return (_number(value),)
        if not isinstance(value, list | tuple) or len(value) != cls.components:
            raise ValueError(cls.describe())
        return tuple(_number(one) for one in value)

    @classmethod
    def describe(cls) -> str:
        """What a setting of this type allows."""
        pairs = "{ uniform = [low, high] }, { log_uniform = [low, high] }, { normal = [mean, sigma] }"
        return f'"{OFF}", a {cls.noun}, {pairs}, {{ choice = [{cls.noun}, ...], weights = [...] }}'

    def limits(self) -> Iterator[float]:
        """Numbers that the setting's range must contain: all that are drawn; of a normal distribution, which is clamped, the mean."""
        return itertools.chain(*(self.values[:1] if self.kind == NORMAL else self.values))

    def bounds(self) -> tuple[float, float]:
        """Least and largest scalar that `sample` returns; a normal distribution is cut at NORMAL_REACH standard deviations."""
        if self.kind == OFF:
            return 0.0, 0.0
        values = [value[0] for value in self.values]
        if self.kind == NORMAL:
            return values[0] - NORMAL_REACH * values[1], values[0] + NORMAL_REACH * values[1]
        return min(values), max(values)

    def sample(self, first: float, second: float) -> float:
        """Scalar from two samples that are uniform in [0, 1), in float64, within `bounds`; off: 0."""
        if self.kind == OFF:
            return 0.0
        (a, *_), (b, *_) = self.values[0], self.values[-1]
        if self.kind == CHOICE:
            weights = self.weights or (1.0,) * len(self.values)
            ends = [end / sum(weights) for end in itertools.accumulate(weights)]
            return self.values[min(bisect.bisect_right(ends, first), len(ends) - 1)][0]
        if self.kind == LOG_UNIFORM:
            return a * (b / a) ** first
        if self.kind == NORMAL:
            normal = math.sqrt(-2.0 * math.log(1.0 - first)) * math.cos(2.0 * math.pi * second)
            return a + b * max(-NORMAL_REACH, min(NORMAL_REACH, normal))
        return a + (b - a) * first

    def to_toml(self) -> Any:
        """The value of `parse`, in types of TOML: numbers, strings, tuples and a mapping."""
        values = tuple(value[0] if self.components == 1 else value for value in self.values)
        if self.kind in (OFF, FIXED):
            return values[0] if values else OFF
        return {self.kind: values} | ({_WEIGHTS: self.weights} if self.weights else {})


@dataclass(frozen=True)
class ColorDistribution(Distribution):
    """Probability distribution of a colour: three independent components in sRGB."""

    components: ClassVar[int] = 3
    noun: ClassVar[str] = "[red, green, blue]"


def _number(value: object) -> float:
    """A finite number as float; raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e30:
        raise ValueError("finite numbers")
    return float(value)


_NONE, _NO_COLOR, _HALF_METRE = Distribution(), ColorDistribution(), Distribution(FIXED, ((0.5,),))
_ELEVATION, _RADIUS = Distribution(UNIFORM, ((30.0,), (80.0,))), Distribution(LOG_UNIFORM, ((1.0,), (8.0,)))
_STRENGTH, _TEMPERATURE = Distribution(LOG_UNIFORM, ((0.1,), (1.0,))), Distribution(UNIFORM, ((2700.0,), (6500.0,)))


@dataclass(frozen=True)
class Randomize:
    """Domain randomization: each episode draws these anew, all off by default. Of these only distractors change geometry and labels. A
    distribution is a value, or `{ uniform = [low, high] }`, `{ log_uniform = [low, high] }`, `{ normal = [mean, sigma] }` (clamped) or `{
    choice = [...], weights = [...] }`. Not in the paper.
    """

    object_hue: Annotated[Distribution, "[-180, 180] °"] = setting(_NONE, "Rotation of the hue of each object.")
    object_brightness: Annotated[Distribution, "[0.05, 20]"] = setting(_NONE, "Factor on the base colour of each object, in linear light.")
    object_roughness: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Roughness of each object.")
    object_metallic: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Metallic factor of each object.")
    object_transmission: Annotated[Distribution, "[0, 1]"] = setting(
        _NONE, "Fraction of the light that passes through each object, in place of its file's; from 0.5 on it casts no shadow."
    )
    object_scratches: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Scratches of each object, by solid noise over its mesh: 1 many.")
    object_rust: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Fraction of each object's surface that is rusty.")
    object_stains: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Fraction of each object's surface that is oily: dark and glossy.")
    object_dust: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Density of dust on each object.")
    object_label: Annotated[Distribution, "[0, 1] m"] = setting(
        _NONE, "Width of a printed label with codes, stuck on each object; 0: none."
    )
    bin_scratches: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Scratches of the bin.")
    bin_stains: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Fraction of the bin that is oily.")
    bin_dust: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Density of dust on the bin.")
    bin_label: Annotated[Distribution, "[0, 1] m"] = setting(_NONE, "Width of a label on the bin; 0: none.")
    bin_color: Annotated[ColorDistribution, "[0, 1] sRGB"] = setting(_NO_COLOR, "Base colour of the bin; with a texture, its factor.")
    bin_roughness: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Roughness of the bin.")
    bin_metallic: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Metallic factor of the bin.")
    bin_textures: str = setting("", "Folder of images: each episode draws the bin's texture; empty: none.", path=True)
    table_color: Annotated[ColorDistribution, "[0, 1] sRGB"] = setting(_NO_COLOR, "Base colour of the table; with a texture, its factor.")
    table_roughness: Annotated[Distribution, "[0, 1]"] = setting(_NONE, "Roughness of the table.")
    table_textures: str = setting("", "Folder of images: each episode draws the table's texture; empty: none.", path=True)
    background_textures: str = setting(
        "",
        "Folder of images: each episode draws the texture of a floor beyond the edge of the table (render.table_size); empty: the "
        "environment map is seen there.",
        path=True,
    )
    surfaces: Annotated[int, f"[0, {MOST_CHOICES // 2}]"] = setting(
        0,
        "Procedural textures (carpet, boards, checks, print, clutter) of table, floor and geometric distractors, beside those of folders.",
    )
    texture_width: Annotated[Distribution, "[0.01, 100] m"] = setting(
        _HALF_METRE, "Width of one repeat of the textures of bin, table and floor."
    )
    lamps: Annotated[Distribution, "[0, 4]"] = setting(
        _NONE, "Number of lamps besides an environment map, rounded: distant discs with soft shadows."
    )
    lamp_variants: Annotated[int, "[1, 64]"] = setting(4, "Variants of each environment map, each with lamps of its own.")
    lamp_elevation: Annotated[Distribution, "[10, 90] °"] = setting(_ELEVATION, "Height of each lamp above the horizon.")
    lamp_radius: Annotated[Distribution, "[0.3, 20] °"] = setting(_RADIUS, "Angular radius of each lamp.")
    lamp_strength: Annotated[Distribution, "[0.01, 100]"] = setting(
        _STRENGTH, "Light of each lamp on a surface that faces up, relative to the map's."
    )
    lamp_temperature: Annotated[Distribution, "[1700, 25000] K"] = setting(_TEMPERATURE, "Colour temperature of each lamp.")
    distractors: Annotated[Distribution, f"[0, {MOST_DISTRACTORS}]"] = setting(
        _NONE,
        "Number of distractors, rounded: objects in the pile without labels, which are no targets. They count towards "
        "arrangement.max_objects.",
    )
    distractor_models: str = setting(
        "", "Folder of distractors, as bake.models, without those of a labelled object's name or shape; empty: geometric solids.", path=True
    )
    exposure: Annotated[Distribution, "[-5, 5] EV"] = setting(_NONE, "Exposure offset, in place of render.exposure_spread.")

    @property
    def most_distractors(self) -> int:
        """Largest number of distractors for which there is room: of a normal distribution, in all draws but 3 in 100,000."""
        if self.distractors.kind == NORMAL:
            (mean,), (sigma,) = self.distractors.values
            return min(MOST_DISTRACTORS, math.ceil(mean + 4.0 * sigma))
        return max((round(count) for (count,) in self.distractors.values), default=0)
