"""Learning-rate schedules as text, so that YAML and model files can hold them."""

from __future__ import annotations

import math
import re

from stable_baselines3.common.utils import LinearSchedule

LINEAR = re.compile(r"lin_(.+)")


def schedule_of(text: str) -> LinearSchedule:
    """
    The schedule that a text names: ``lin_1e-3`` starts at 1e-3 and falls linearly to 0 as training ends.

    :raises ValueError: for any other text
    """
    match = LINEAR.fullmatch(text)
    try:
        start = float(match.group(1) if match else "")
    except ValueError:
        start = math.nan
    if not (math.isfinite(start) and start >= 0):
        raise ValueError(f'learning_rate is "{text}"; it must be a number, or a linear schedule such as lin_1e-3')
    return LinearSchedule(start, 0.0, 1.0)
