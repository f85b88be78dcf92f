"""Pictures of charts, rendered in this process: a process of its own for each would take a second."""

import re
from collections.abc import Sequence

import cv2
import numpy as np

from synpick_warp.system.codecs.charts import SCALE, VEGA_LITE, Spec


def render_here(specs: Sequence[Spec], scale: float = SCALE) -> list[bytes]:
    """As `render_charts`, in this process."""
    import vl_convert

    return [vl_convert.vegalite_to_png(spec, vl_version=VEGA_LITE, scale=scale) for spec in specs]


def picture_of(spec: Spec, scale: float = SCALE) -> np.ndarray:
    """RGB image (H, W, 3) uint8 of a chart."""
    (data,) = render_here([spec], scale)
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def tick_texts(spec: Spec) -> list[str]:
    """Texts of the ticks of a chart's axes."""
    import vl_convert

    groups = re.findall(r'role-axis-label".*?</g>', vl_convert.vegalite_to_svg(spec, vl_version=VEGA_LITE))
    return [text for group in groups for text in re.findall("<text[^>]*>([^<]*)</text>", group)]


def near(picture: np.ndarray, color: str, tolerance: int = 40) -> np.ndarray:
    """Pixels of about a colour #rrggbb (H, W) bool."""
    return (np.abs(picture.astype(int) - list(bytes.fromhex(color[1:]))) <= tolerance).all(axis=2)
