"""The panels of the page, and the events that concern more than one of them."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.scenes.folder import StoredView
from lexsplat.scenes.scene import Scene
from lexsplat.viewer import pages
from lexsplat.viewer.controls import EventRunner
from lexsplat.viewer.display import Display, page_camera
from lexsplat.viewer.prompt_panel import PromptPanel
from lexsplat.viewer.search_panel import SearchPanel
from lexsplat.viewer.session import Question, Session
from lexsplat.viewer.side_panels import CamerasPanel, ClickPanel, SavePanel, SelectionPanel

if TYPE_CHECKING:
    import viser


class Panels:
    """Everything on the page except the scene itself.

    Fast changes are applied at once under a lock. Slow work runs in the background, and is skipped if newer work
    about the same subject is waiting.
    """

    def __init__(self, server: viser.ViserServer, session: Session, display: Display) -> None:
        self.session, self.display = session, display
        self.events = EventRunner(lambda text: self.search.show_message(text))
        self.lock = threading.RLock()
        self.seconds: dict[str, float] = {}
        """Duration of the latest "ask", "refine" and "click", from the event to the last byte queued."""
        self._quiet_until = 0.0
        self._eye: NDArray[np.float64] | None = None
        self._viewpoint: Camera | None = None

        gui = server.gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(29, 78, 137), dark_mode=False
        )
        title = title_of(session.scene)
        gui.set_panel_label(title)
        _run_script(gui, pages.page_script(title, session.history.vocabulary[0]))
        gui.main_panel.dock_left()
        gui.main_panel.set_width(320)
        self.search = SearchPanel(gui, self)
        self.prompt = PromptPanel(gui, self)
        side = gui.add_panel()
        side.dock_right()
        side.set_width(310)
        with side.add_tab("Selection"):
            self.selection = SelectionPanel(gui, self)
        with side.add_tab("What is this?"):
            self.click = ClickPanel(gui, self)
        with side.add_tab("Cameras"):
            CamerasPanel(gui, self)
        with side.add_tab("Save"):
            SavePanel(gui, self)
        display.add_frustums(self._jump, visible=False)
        server.scene.on_click()(self._clicked)
        server.on_client_connect(self._connected)
        self.redraw()
        self.search.show_legend()
        self.events.later("warm up", session.warm_up)

    def stop(self) -> None:
        """Finish the current background work and drop the rest."""
        self.events.stop()

    def wait(self) -> None:
        """Wait until the background work is done."""
        self.events.wait()

    # -- prompts

    def ask(self, text: str, client: Any = None) -> None:
        """Show a prompt: provisional colors at once, threshold and selection when they are known.

        Args:
            text: The prompt.
            client: The page that asks; its camera defines left and right. None takes the page that moved last.

        Raises:
            QueryError: If the prompt is empty or too long.
        """
        started = time.perf_counter()
        with self.lock:
            question = self.session.ask(text)
            self.redraw()
            self.seconds["ask"] = time.perf_counter() - started
            self.search.clear()
            self._show_controls()
        self.refine_later(question, client, started)

    def refine_later(self, question: Question, client: Any, started: float | None = None) -> None:
        """Compute the final answer to a prompt in the background, and show it.

        Args:
            question: The prompt.
            client: See `ask`.
            started: When the event happened (`time.perf_counter`); None means now.
        """
        since = time.perf_counter() if started is None else started
        viewpoint = self._camera_of(client)
        self.events.later(f"refine {question.text}", lambda: self._refine(question, viewpoint, since))

    def _refine(self, question: Question, viewpoint: Camera | None, started: float) -> None:
        self.session.refine(question, viewpoint)
        with self.lock:
            if question not in self.session.all_questions():
                return
            self.redraw()
            self.seconds["refine"] = time.perf_counter() - started
            self._show_controls()
        if question is not self.session.clicked:
            self.session.history.add(question.text)
            self.search.show_history()
        self.selection.show()

    # -- drawing

    def redraw(self) -> None:
        """Send the colors that changed."""
        self.display.draw(self.session.colors(self._eye))

    def show_current(self) -> None:
        """Show the current question: its controls at once, its selection in the background."""
        with self.lock:
            self._show_controls()
        self.events.later("selection", self.selection.show)

    def _show_controls(self) -> None:
        self.prompt.show()
        self.search.show_legend()

    # -- clicks and cameras

    def go_to(self, name: str, client: Any) -> None:
        """Move the camera of a page to a view; an unknown name is ignored."""
        view = self.session.scene.views.get(name)
        if view is not None:
            self.display.jump(client, view.camera)

    def _jump(self, view: StoredView, client: Any) -> None:
        self._quiet_until = time.monotonic() + 0.3
        self.display.jump(client, view.camera)

    def _clicked(self, event: Any) -> None:
        if (
            time.monotonic() < self._quiet_until
        ):  # viser also reports a click on a frustum as a click on the scene
            return
        camera = page_camera(event.client)
        x, y = event.screen_pos[0] * camera.width, event.screen_pos[1] * camera.height
        self.events.run(lambda: self.click.what_is(camera, float(x), float(y)))

    def _connected(self, client: Any) -> None:
        client.camera.on_update(self._camera_changed)
        self._camera_changed(client.camera)

    def _camera_changed(self, camera: viser.CameraHandle) -> None:
        eye = np.asarray(camera.position, dtype=np.float64)
        if not (np.isfinite(eye).all() and camera.image_height > 0 and camera.image_width > 0):
            return
        moved = self._eye is None or not np.array_equal(eye, self._eye)
        self._eye = eye
        self._viewpoint = page_camera(camera.client)
        if moved and self.session.mode == "depth":
            self.events.later("depth", self._redraw_depth)

    def _redraw_depth(self) -> None:
        with self.lock:
            self.redraw()
            self.search.show_legend()

    def _camera_of(self, client: Any) -> Camera | None:
        """The camera of a page. For None, or a page without a size yet, that of the page that moved last."""
        if client is None:
            return self._viewpoint
        try:
            return page_camera(client)
        except (ValueError, ZeroDivisionError):
            return self._viewpoint


def _run_script(gui: viser.GuiApi, script: str) -> None:
    """Run a script in every page. viser uses this message for its plots only, so it is not part of its public API."""
    from viser._messages import RunJavascriptMessage

    gui._websock_interface.queue_message(RunJavascriptMessage(script))


def title_of(scene: Scene) -> str:
    """The title of the page: "lexsplat: SCENE"."""
    if scene.folder is None:
        return "lexsplat"
    return f"lexsplat: {'demo' if scene.folder.is_bundled else scene.folder.root.resolve().name}"
