"""The controls of the page, and what happens when they are used."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import LexsplatError
from lexsplat.scenes.folder import StoredView
from lexsplat.viewer import pages
from lexsplat.viewer.coloring import MODES
from lexsplat.viewer.display import Display, page_camera
from lexsplat.viewer.recording import encode_png, encode_video
from lexsplat.viewer.session import EXPORT_ENDINGS, Question, Session
from lexsplat.viewer.vocabulary import suggestions

if TYPE_CHECKING:
    import viser

logger = logging.getLogger("lexsplat")

MODE_LABELS = dict(zip(MODES, ("RGB", "Relevancy", "Language (PCA)", "Codes", "Uncertainty", "Depth")))
_NO_PROMPT = "-"
_THUMBNAILS = 3
_ORBIT = {"frames": 60, "height": 480, "fps": 20}
HINT = "Type what you look for and press Enter, or click on something in the scene."


class Panels:
    """Everything on the page beside the scene.

    Quick changes happen at once under a lock; what takes longer is done by one worker, and only as long as it is
    still wanted.

    Args:
        server: viser's server.
        session: What is asked and shown.
        display: The scene on the page.
    """

    def __init__(self, server: viser.ViserServer, session: Session, display: Display) -> None:
        self.server, self.session, self.display = server, session, display
        self.seconds: dict[str, float] = {}
        """How long the last change of each kind took, from the event to the last byte queued."""
        self._lock = threading.RLock()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="lexsplat-viewer")
        self._latest: dict[str, Callable[[], None]] = {}
        self._quiet_until = 0.0
        self._eye: np.ndarray | None = None
        self._viewpoint: Camera | None = None
        gui = server.gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(29, 78, 137), dark_mode=False
        )
        gui.set_panel_label("lexsplat")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(320)
        self._build_search(gui)
        side = gui.add_panel()
        side.dock_right()
        side.set_width(310)
        with side.add_tab("Selection"):
            self._build_selection(gui)
        with side.add_tab("What is this?"):
            self._build_what(gui)
        with side.add_tab("Cameras"):
            self._build_cameras(gui)
        with side.add_tab("Save"):
            self._build_save(gui)
        server.scene.on_click()(self._clicked)
        server.on_client_connect(self._connected)
        self._redraw()
        self._tell()
        self._worker.submit(lambda: self._guarded(session.warm_up))

    def stop(self) -> None:
        """Finish the work that is going on, drop the rest."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def wait(self) -> None:
        """Until the worker has nothing to do."""
        self._worker.submit(lambda: None).result()

    # -- building

    def _build_search(self, gui: viser.GuiApi) -> None:
        form = gui.add_form(None)
        with form:
            self._text = gui.add_text("Find", "")
        self._when(form.on_submit, self._submit)
        self._when(self._text.on_update, lambda _: self._suggest())
        self._suggestions = gui.add_button_group("Try", ("",), visible=False)
        self._when(self._suggestions.on_click, lambda client: self.ask(self._suggestions.value, client))
        self._history = gui.add_dropdown(
            "Recent", (_NO_PROMPT, *self.session.memory.history), hint="What was asked before."
        )
        self._when(self._history.on_update, self._ask_again)
        self._message = gui.add_html("", visible=False)
        self._mode = gui.add_dropdown("Show", tuple(MODE_LABELS.values()))
        self._when(self._mode.on_update, lambda _: self._change_mode())
        self._legend = gui.add_html("")
        self._controls = gui.add_folder("Prompt", visible=False)
        with self._controls:
            self._prompt = gui.add_dropdown(
                "Prompt", (_NO_PROMPT,), hint="The one the controls below are for."
            )
            self._when(self._prompt.on_update, lambda _: self._choose_prompt())
            self._shown = gui.add_checkbox("Shown", True)
            self._when(self._shown.on_update, lambda _: self._change_prompt())
            self._color = gui.add_rgb("Color", (230, 57, 70), hint="Used when several prompts are shown.")
            self._when(self._color.on_update, lambda _: self._change_prompt())
            self._automatic = gui.add_checkbox("Automatic", True, hint="A threshold found from the scene.")
            self._when(self._automatic.on_update, self._change_threshold)
            self._threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.005, 0.5, disabled=True)
            self._when(self._threshold.on_update, self._change_threshold)
            buttons = gui.add_button_group("", ("Remove", "Remove all"))
            self._when(buttons.on_click, lambda _: self._remove(buttons.value))
        self._opacity = gui.add_slider("Opacity", 0.0, 1.0, 0.05, self.session.opacity)
        self._when(self._opacity.on_update, lambda _: self._change_strength())
        self._fade = gui.add_slider("Fade rest", 0.0, 1.0, 0.05, self.session.fade)
        self._when(self._fade.on_update, lambda _: self._change_strength())

    def _build_selection(self, gui: viser.GuiApi) -> None:
        self._facts = gui.add_html(pages.selection_facts(None))
        blank = np.full((4, 4, 3), 255, dtype=np.uint8)
        self._format = gui.add_dropdown("File", EXPORT_ENDINGS)
        self._download = gui.add_button("Download selection", disabled=True)
        self._when(self._download.on_click, self._send_selection)
        self._go_to = gui.add_button_group(
            "Go to", ("",), visible=False, hint="The views that show most of it."
        )
        self._when(self._go_to.on_click, lambda client: self._go(self._go_to.value, client))
        self._views = [gui.add_image(blank, label="", visible=False) for _ in range(_THUMBNAILS)]

    def _build_what(self, gui: viser.GuiApi) -> None:
        self._answer = gui.add_html(pages.note("Click on something in the scene."))
        self._suggest_answer = gui.add_button_group("Find", ("",), visible=False)
        self._when(self._suggest_answer.on_click, lambda client: self.ask(self._suggest_answer.value, client))
        self._vocabulary = gui.add_text(
            "Words", ", ".join(self.session.memory.vocabulary), multiline=True,
            hint="What the answer is chosen from, separated by commas. Empty brings the first list back.",
        )  # fmt: skip
        save = gui.add_button("Use these words")
        self._when(save.on_click, lambda _: self._change_vocabulary())

    def _build_cameras(self, gui: viser.GuiApi) -> None:
        names = tuple(self.session.scene.views)
        self._frustums = gui.add_checkbox("Show cameras", False, hint="Click on one to go there.")
        self._when(self._frustums.on_update, lambda _: self.display.show_frustums(self._frustums.value))
        if names:
            jump = gui.add_dropdown("Go to", names)
            self._when(jump.on_update, lambda client: self._go(jump.value, client))
            go = gui.add_button("Go there")
            self._when(go.on_click, lambda client: self._go(jump.value, client))
        held_out = sum(view.split == "test" for view in self.session.scene.views.values())
        train, test = (f"rgb{color}" for color in ((90, 110, 140), (232, 124, 3)))
        gui.add_html(
            pages.box(
                f'<span style="color:{train}">■</span> {len(names) - held_out} training views '
                f'<span style="color:{test}">■</span> {held_out} held out'
            )
        )
        self.display.add_frustums(self._jumped, visible=False)

    def _build_save(self, gui: viser.GuiApi) -> None:
        shot = gui.add_button("Screenshot (.png)")
        self._when(shot.on_click, self._screenshot)
        orbit = gui.add_button("Orbit video", hint="One turn around what the camera looks at.")
        self._when(orbit.on_click, self._orbit)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        splats = self.display.splats
        drawn = f"{splats.drawn:,} of {splats.total:,} splats are drawn"
        why = "." if splats.drawn == splats.total else ", those that cover most; answers use all of them."
        gui.add_html(pages.note(drawn + why))

    # -- asking

    def ask(self, text: str, client: Any = None) -> None:
        """Ask for something: colors at once, threshold and selection when they are known.

        Args:
            text: The prompt.
            client: The page that asks: left and right are those of its camera. None takes the page that moved last.
        """
        started = time.perf_counter()
        with self._lock:
            question = self.session.ask(text)
            self._redraw()
            self.seconds["ask"] = time.perf_counter() - started
            self._show_prompt()
        viewpoint = self._camera_of(client)
        self._later(f"refine {question.text}", lambda: self._refine(question, started, viewpoint))

    def _camera_of(self, client: Any) -> Camera | None:
        """Where a page stands; none, or one that has no size yet, takes the one that moved last."""
        if client is None:
            return self._viewpoint
        try:
            return page_camera(client)
        except (ValueError, ZeroDivisionError):
            return self._viewpoint

    def _submit(self, client: Any) -> None:
        time.sleep(0.06)  # the page sends the last key stroke up to 50 ms late
        self.ask(self._text.value, client)

    def _suggest(self) -> None:
        memory = self.session.memory
        with self._lock:  # key strokes are told by several threads: each looks at what is there now
            options = suggestions(self._text.value, memory.history, memory.vocabulary)
            if options:
                self._suggestions.options = tuple(options)
            self._suggestions.visible = bool(options)

    def _ask_again(self, client: Any) -> None:
        if self._history.value != _NO_PROMPT:
            self.ask(self._history.value, client)
            _set(self._history, _NO_PROMPT)

    def _refine(self, question: Question, started: float, viewpoint: Camera | None) -> None:
        self.session.refine(question, viewpoint)
        with self._lock:
            if question not in self.session.all_questions():
                return
            self._redraw()
            self.seconds["refine"] = time.perf_counter() - started
            self._show_prompt()
        if question is not self.session.clicked:
            self.session.memory.remember(question.text)
            self._history.options = (_NO_PROMPT, *self.session.memory.history)
        self._show_selection()

    # -- changing what is shown

    def _change_mode(self) -> None:
        with self._lock:
            label = self._mode.value
            self.session.mode = next((mode for mode, name in MODE_LABELS.items() if name == label), "photo")
            self._redraw()
            self._tell()

    def _choose_prompt(self) -> None:
        with self._lock:
            self.session.current = self.session.find(self._prompt.value)
            self._show_prompt()
        self._later("selection", self._show_selection)

    def _change_prompt(self) -> None:
        question = self.session.current
        if question is None:
            return
        with self._lock:
            question.layer.shown = bool(self._shown.value)
            red, green, blue = (int(np.clip(value, 0, 255)) for value in self._color.value)
            question.layer.color = (red, green, blue)
            self._redraw()
            self._tell()

    def _change_threshold(self, client: Any) -> None:
        question = self.session.current
        if question is None or question is self.session.clicked:
            return
        started = time.perf_counter()
        with self._lock:
            automatic = bool(self._automatic.value)
            self._threshold.disabled = automatic
            value = None if automatic else float(np.clip(self._threshold.value, 0, 1))
            self.session.set_threshold(question, value)
            self._redraw()
            self._tell()
        viewpoint = self._camera_of(client)
        self._later(f"refine {question.text}", lambda: self._refine(question, started, viewpoint))

    def _change_strength(self) -> None:
        with self._lock:
            self.session.opacity = float(np.clip(self._opacity.value, 0, 1))
            self.session.fade = float(np.clip(self._fade.value, 0, 1))
            self._redraw()

    def _remove(self, which: str) -> None:
        with self._lock:
            if which == "Remove all":
                for question in self.session.all_questions():
                    self.session.remove(question)
            elif self.session.current:
                self.session.remove(self.session.current)
            self._redraw()
            self._show_prompt()
        self._later("selection", self._show_selection)

    def _change_vocabulary(self) -> None:
        phrases = self._vocabulary.value.replace("\n", ",").split(",")
        self.session.memory.set_vocabulary(phrases)
        _set(self._vocabulary, ", ".join(self.session.memory.vocabulary))

    # -- clicks and cameras

    def _clicked(self, event: Any) -> None:
        if time.monotonic() < self._quiet_until:  # the click was on a camera
            return
        camera = page_camera(event.client)
        x, y = event.screen_pos[0] * camera.width, event.screen_pos[1] * camera.height
        self._guarded(lambda: self._what_is(camera, float(x), float(y)))

    def _what_is(self, camera: Any, x: float, y: float) -> None:
        started = time.perf_counter()
        with self._lock:
            found = self.session.what_is(camera, x, y)
            self._redraw()
            self.seconds["click"] = time.perf_counter() - started
            self._answer.content = pages.answer(found)
            self._suggest_answer.options = tuple(phrase for phrase, _ in found.phrases[:3]) or ("",)
            self._suggest_answer.visible = bool(found.phrases)
            self._show_prompt()
        self._later("selection", self._show_selection)

    def _jumped(self, view: StoredView, client: Any) -> None:
        self._quiet_until = time.monotonic() + 0.3
        self.display.jump(client, view.camera)

    def _go(self, name: str, client: Any) -> None:
        view = self.session.scene.views.get(name)
        if view is not None and client is not None:
            self.display.jump(client, view.camera)

    def _connected(self, client: Any) -> None:
        client.camera.on_update(self._moved)
        self._moved(client.camera)

    def _moved(self, camera: Any) -> None:
        eye = np.asarray(camera.position, dtype=np.float64)
        if not (np.isfinite(eye).all() and camera.image_height > 0 and camera.image_width > 0):
            return
        far = self._eye is None or float(np.linalg.norm(eye - self._eye)) > 0
        self._eye = eye
        self._viewpoint = page_camera(camera.client)
        if far and self.session.mode == "depth" and self._lock.acquire(blocking=False):
            try:
                self._redraw()
                self._tell()
            finally:
                self._lock.release()

    # -- saving

    def _send_selection(self, client: Any) -> None:
        selection = self.session.selection
        if selection is not None and client is not None:
            client.send_file_download(
                *self.session.export(selection, self._format.value), save_immediately=True
            )

    def _screenshot(self, client: Any) -> None:
        with self.display.without_frustums():
            picture = self.display.picture(client, int(client.camera.image_height))
        client.send_file_download("lexsplat.png", encode_png(picture), save_immediately=True)

    def _orbit(self, client: Any) -> None:
        frames = int(_ORBIT["frames"])
        self._progress.visible = True

        def told(done: int) -> None:
            _set(self._progress, 100.0 * done / frames)

        try:
            with self.display.without_frustums():
                pictures = self.display.orbit_frames(client, frames, int(_ORBIT["height"]), told)
            suffix, content = encode_video(pictures, int(_ORBIT["fps"]))
        finally:
            self._progress.visible = False
        client.send_file_download(f"orbit{suffix}", content, save_immediately=True)

    # -- drawing

    def _redraw(self) -> None:
        self.display.draw(self.session.colors(self._eye))

    def _tell(self) -> None:
        session = self.session
        self._legend.content = pages.legend(
            session.all_questions(), session.mode, session.coloring.scale, HINT
        )

    def _show_prompt(self) -> None:
        """Bring the controls in line with the current prompt."""
        current = self.session.current
        self._controls.visible = current is not None
        names = tuple(question.text for question in self.session.all_questions())
        self._prompt.options = names or (_NO_PROMPT,)
        _set(self._prompt, current.text if current else _NO_PROMPT)
        _set(self._mode, MODE_LABELS[self.session.mode])
        by_hand = current is not None and current.manual is not None
        _set(self._automatic, not by_hand)
        self._threshold.disabled = not by_hand
        if current:
            _set(self._shown, current.layer.shown)
            _set(self._color, current.layer.color)
            _set(self._threshold, round(float(current.layer.threshold), 3))
        self._tell()

    def _show_selection(self) -> None:
        current = self.session.current
        selection = current.selection if current else None
        self._facts.content = pages.selection_facts(current)
        self._download.disabled = not selection
        best: list[tuple[str, float, Any]] = []
        if selection:
            shares = self.session.best_views(selection, _THUMBNAILS)
            best = [(name, share, self.session.thumbnail(name, selection)) for name, share in shares]
        self._go_to.visible = bool(best)
        self._go_to.options = tuple(name for name, _, _ in best) or ("",)
        for image, (name, share, picture) in zip(self._views, best):
            image.image = picture
            image.label = f"{name}, {share:.1%} of the picture"
        for number, image in enumerate(self._views):
            image.visible = number < len(best)

    # -- running

    def _when(self, register: Callable[[Any], Any], work: Callable[[Any], None]) -> None:
        """Do something with the page that used a control (what we change ourselves is no page's doing)."""

        def happened(event: Any) -> None:
            if event.client is not None:
                self._guarded(lambda: work(event.client))

        register(happened)

    def _later(self, subject: str, work: Callable[[], None]) -> None:
        """Let the worker do something, unless something newer about the same subject comes first."""
        self._latest[subject] = work

        def run() -> None:
            if self._latest.get(subject) is work:
                del self._latest[subject]
                self._guarded(work, background=True)

        with contextlib.suppress(RuntimeError):  # the viewer is being stopped
            self._worker.submit(run)

    def _guarded(self, work: Callable[[], None], background: bool = False) -> None:
        """Do something for the page, and tell what goes wrong there in one line, until the page asks for more."""
        try:
            work()
            if not background:
                self._message.visible = False
        except LexsplatError as error:
            self._fail(str(error))
        except (TimeoutError, RuntimeError, ValueError) as error:
            logger.warning("viewer: %s", error)
            self._fail(f"That did not work: {error}")

    def _fail(self, text: str) -> None:
        self._message.content = pages.warning(text)
        self._message.visible = True


def _set(control: Any, value: object) -> None:
    """Give a control a value (viser's annotations know it as read-only)."""
    control.value = value
