"""The tabs of the right panel: selection, "What is this?", cameras, files."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from lexsplat.geometry.cameras import Camera
from lexsplat.viewer import pages
from lexsplat.viewer.controls import set_value
from lexsplat.viewer.display import TEST_COLOR, TRAIN_COLOR
from lexsplat.viewer.recording import encode_png, encode_video
from lexsplat.viewer.session import EXPORT_ENDINGS

if TYPE_CHECKING:
    import viser

    from lexsplat.viewer.panels import Panels

_THUMBNAILS = 3
_ORBIT = {"frames": 60, "height": 480, "fps": 20}


class SelectionPanel:
    """Facts, download and best views of the current selection."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        self._session = panels.session
        self._facts = gui.add_html(pages.selection_facts(None))
        self._format = gui.add_dropdown("File", EXPORT_ENDINGS)
        self._download = gui.add_button("Download selection", disabled=True)
        panels.events.on(self._download.on_click, self._send)
        self._go_to = gui.add_button_group(
            "Go to", ("",), visible=False, hint="Views that show most of the selection."
        )
        panels.events.on(self._go_to.on_click, lambda client: panels.go_to(self._go_to.value, client))
        blank = np.full((4, 4, 3), 255, dtype=np.uint8)
        self._thumbnails = [gui.add_image(blank, label="", visible=False) for _ in range(_THUMBNAILS)]

    def show(self) -> None:
        """Show the current selection."""
        current = self._session.current
        selection = current.selection if current else None
        self._facts.content = pages.selection_facts(current)
        self._download.disabled = not selection
        shares = selection.view_shares[:_THUMBNAILS] if selection else []
        best = [(name, share) for name, share in shares if share > 0]
        self._go_to.visible = bool(best)
        self._go_to.options = tuple(name for name, _ in best) or ("",)
        for number, handle in enumerate(self._thumbnails):
            if selection and number < len(best):
                name, share = best[number]
                handle.image = self._session.thumbnail(name, selection)
                handle.label = f"{name}, {share:.1%} of the image"
            handle.visible = number < len(best)

    def _send(self, client: Any) -> None:
        selection = self._session.selection
        if selection is not None:
            name, content = self._session.export(selection, self._format.value)
            client.send_file_download(name, content, save_immediately=True)


class ClickPanel:
    """Names for the clicked object, and the vocabulary they come from."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        self._panels, self._history = panels, panels.session.history
        self._answer = gui.add_html(pages.note("Click an object in the scene."))
        self._ask = gui.add_button_group("Find", ("",), visible=False)
        panels.events.on(self._ask.on_click, lambda client: panels.ask(self._ask.value, client))
        self._vocabulary = gui.add_text(
            "Words", ", ".join(self._history.vocabulary), multiline=True,
            hint="Candidate names, separated by commas. An empty list restores the default.",
        )  # fmt: skip
        save = gui.add_button("Use these words")
        panels.events.on(save.on_click, lambda _: self.change_vocabulary())

    def what_is(self, camera: Camera, x: float, y: float) -> None:
        """Name and select the surface at a pixel of a page."""
        started = time.perf_counter()
        with self._panels.lock:
            answer = self._panels.session.what_is(camera, x, y)
            self._panels.redraw()
            self._answer.content = pages.click_answer(answer)
            self._ask.options = tuple(phrase for phrase, _ in answer.phrases[:3]) or ("",)
            self._ask.visible = bool(answer.phrases)
            self._panels.seconds["click"] = time.perf_counter() - started
        self._panels.show_current()

    def change_vocabulary(self) -> None:
        """Take over the vocabulary that the user has typed."""
        self._history.set_vocabulary(self._vocabulary.value.replace("\n", ",").split(","))
        set_value(self._vocabulary, ", ".join(self._history.vocabulary))


class CamerasPanel:
    """Jumps to the views of the capture, and their frustums."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        views = panels.session.scene.views
        frustums = gui.add_checkbox("Show cameras", False, hint="Click a camera to jump to it.")
        panels.events.on(frustums.on_update, lambda _: panels.display.show_frustums(frustums.value))
        if views:
            view = gui.add_dropdown("Go to", tuple(views))
            panels.events.on(view.on_update, lambda client: panels.go_to(view.value, client))
            go = gui.add_button("Go there")
            panels.events.on(go.on_click, lambda client: panels.go_to(view.value, client))
        test = sum(view.split == "test" for view in views.values())
        gui.add_html(pages.view_counts(len(views) - test, TRAIN_COLOR, test, TEST_COLOR))


class SavePanel:
    """Screenshot and orbit video."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        self._display = panels.display
        screenshot = gui.add_button("Screenshot (.png)")
        panels.events.on(screenshot.on_click, self._send_screenshot)
        orbit = gui.add_button("Orbit video", hint="One turn around the point that the camera looks at.")
        panels.events.on(orbit.on_click, self._send_orbit)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        splats = self._display.splats
        drawn = f"{splats.drawn:,} of {splats.total:,} splats are drawn"
        rest = "." if splats.drawn == splats.total else ": those that cover most. Answers use all of them."
        gui.add_html(pages.note(drawn + rest))

    def _send_screenshot(self, client: Any) -> None:
        with self._display.without_frustums():
            image = self._display.image(client, int(client.camera.image_height))
        client.send_file_download("lexsplat.png", encode_png(image), save_immediately=True)

    def _send_orbit(self, client: Any) -> None:
        frames = _ORBIT["frames"]
        self._progress.visible = True

        def listener(done: int) -> None:
            set_value(self._progress, 100.0 * done / frames)

        try:
            with self._display.without_frustums():
                images = self._display.orbit_frames(client, frames, _ORBIT["height"], listener)
            suffix, content = encode_video(images, _ORBIT["fps"])
        finally:
            self._progress.visible = False
        client.send_file_download(f"orbit{suffix}", content, save_immediately=True)
