"""Every reader of lexsplat with a valid input, checks of its result, and mutations of the input.

One module per package of the product; each registers its readers in `READERS`. To add a reader, write a function that
returns a `Reader` and decorate it with ``@reader``. `running` runs them.
"""

from support.hostile import (  # noqa: F401  (importing a module registers its readers)
    captures,
    features,
    images,
    language,
    queries,
    reconstruction,
    scenes,
    splats,
    viewer,
)
from support.hostile.registry import READERS, Reader

__all__ = ["READERS", "Reader"]
