"""A scene as a static page that is searched in the browser, with no server: ``lexsplat publish``."""

from lexsplat.scenes.publishing.writing import MOST_SPLATS, Published, PublishOptions, check_target, publish

__all__ = ["MOST_SPLATS", "PublishOptions", "Published", "check_target", "publish"]
