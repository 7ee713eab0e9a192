"""The controls of the current prompt: visibility, color, threshold, removal; and how marks are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lexsplat.viewer.controls import set_value
from lexsplat.viewer.search_panel import NO_PROMPT

if TYPE_CHECKING:
    import viser

    from lexsplat.viewer.panels import Panels

_REMOVE, _REMOVE_ALL = "Remove", "Remove all"


class PromptPanel:
    """Controls of one prompt, and the opacity of all marks."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        self._panels, self._session = panels, panels.session
        on = panels.events.on
        self._folder = gui.add_folder("Prompt", visible=False)
        with self._folder:
            self._prompt = gui.add_dropdown(
                "Prompt", (NO_PROMPT,), hint="The prompt that these controls change."
            )
            on(self._prompt.on_update, lambda _: self._choose())
            self._shown = gui.add_checkbox("Shown", True)
            on(self._shown.on_update, lambda _: self._change_layer())
            self._color = gui.add_rgb("Color", (230, 57, 70), hint="Used when several prompts are shown.")
            on(self._color.on_update, lambda _: self._change_layer())
            self._automatic = gui.add_checkbox("Automatic", True, hint="Use the automatic threshold.")
            on(self._automatic.on_update, self.change_threshold)
            self._threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.005, 0.5, disabled=True)
            on(self._threshold.on_update, self.change_threshold)
            buttons = gui.add_button_group("", (_REMOVE, _REMOVE_ALL))
            on(buttons.on_click, lambda _: self._remove() if buttons.value == _REMOVE else self.remove_all())
        self._opacity = gui.add_slider(
            "Opacity", 0.0, 1.0, 0.05, self._session.opacity, hint="Opacity of the marks."
        )
        on(self._opacity.on_update, lambda _: self._change_marks())
        self._fade = gui.add_slider("Fade rest", 0.0, 1.0, 0.05, self._session.fade)
        on(self._fade.on_update, lambda _: self._change_marks())

    def show(self) -> None:
        """Set the controls to the state of the current prompt."""
        current = self._session.current
        self._folder.visible = current is not None
        names = tuple(question.text for question in self._session.all_questions())
        self._prompt.options = names or (NO_PROMPT,)
        set_value(self._prompt, current.text if current else NO_PROMPT)
        manual = current is not None and current.manual is not None
        set_value(self._automatic, not manual)
        self._threshold.disabled = not manual
        if current:
            set_value(self._shown, current.layer.shown)
            set_value(self._color, current.layer.color)
            set_value(self._threshold, round(float(current.layer.threshold), 3))

    def change_threshold(self, client: Any) -> None:
        """Apply the threshold controls to the current prompt."""
        question = self._session.current
        if question is None or question is self._session.clicked:
            return
        with self._panels.lock:
            automatic = bool(self._automatic.value)
            self._threshold.disabled = automatic
            value = None if automatic else float(np.clip(self._threshold.value, 0, 1))
            self._session.set_threshold(question, value)
            self._panels.redraw()
            self._panels.search.show_legend()
        self._panels.refine_later(question, client)

    def remove_all(self) -> None:
        """Remove all prompts and empty the search box."""
        with self._panels.lock:
            for question in self._session.all_questions():
                self._session.remove(question)
            self._panels.redraw()
            self._panels.search.clear()
        self._panels.show_current()

    def _remove(self) -> None:
        with self._panels.lock:
            if self._session.current:
                self._session.remove(self._session.current)
                self._panels.redraw()
        self._panels.show_current()

    def _choose(self) -> None:
        with self._panels.lock:
            self._session.current = self._session.find(self._prompt.value)
        self._panels.show_current()

    def _change_layer(self) -> None:
        question = self._session.current
        if question is None:
            return
        with self._panels.lock:
            question.layer.shown = bool(self._shown.value)
            red, green, blue = (int(np.clip(value, 0, 255)) for value in self._color.value)
            question.layer.color = (red, green, blue)
            self._panels.redraw()
            self._panels.search.show_legend()

    def _change_marks(self) -> None:
        with self._panels.lock:
            self._session.opacity = float(np.clip(self._opacity.value, 0, 1))
            self._session.fade = float(np.clip(self._fade.value, 0, 1))
            self._panels.redraw()
