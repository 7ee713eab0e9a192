"""Colors as they are written: three numbers, "#ff8800" or a name."""

from __future__ import annotations

from collections.abc import Sequence


def parse_color(words: Sequence[str]) -> tuple[float, float, float]:
    """Red, green and blue in 0..1 of three numbers, of "#ff8800" or of a name of CSS such as "orange".

    Raises:
        ValueError: If it is none of them.
    """
    from PIL import ImageColor

    try:
        if len(words) == 1:
            red, green, blue = (value / 255 for value in ImageColor.getrgb(words[0]))
        else:
            red, green, blue = map(float, words)
    except ValueError:  # also of four values: there is no transparency
        expected = 'three numbers in 0..1, a color such as "#ff8800" or a name such as orange'
        raise ValueError(f"expected {expected}, found {' '.join(words)!r}") from None
    return red, green, blue
