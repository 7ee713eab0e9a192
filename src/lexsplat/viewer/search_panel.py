"""The left panel: the search box, the mode, and the legend."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from lexsplat.viewer import pages
from lexsplat.viewer.coloring import MODES
from lexsplat.viewer.controls import set_value
from lexsplat.viewer.vocabulary import suggestions

if TYPE_CHECKING:
    import viser

    from lexsplat.viewer.panels import Panels

MODE_LABELS = dict(zip(MODES, ("RGB", "Relevancy", "Language (PCA)", "Codes", "Uncertainty", "Depth")))
NO_PROMPT = "-"


class SearchPanel:
    """Search box with completions and history, error message, mode and legend."""

    def __init__(self, gui: viser.GuiApi, panels: Panels) -> None:
        self._panels, self._session = panels, panels.session
        on = panels.events.on
        form = gui.add_form(None)
        with form:
            self._text = gui.add_text("Find", "", hint="What to look for. Press Enter to search.")
        on(form.on_submit, self._submit)
        on(self._text.on_update, lambda _: self._suggest())
        self._suggestions = gui.add_button_group("Try", ("",), visible=False)
        on(self._suggestions.on_click, lambda client: panels.ask(self._suggestions.value, client))
        self._recent = gui.add_dropdown("Recent", (NO_PROMPT,), hint="Earlier prompts.")
        on(self._recent.on_update, self._ask_again)
        self._message = gui.add_html("", visible=False)
        self._mode = gui.add_dropdown("Show", tuple(MODE_LABELS.values()))
        on(self._mode.on_update, lambda _: self._change_mode())
        self._legend = gui.add_html("")
        self.show_history()

    def clear(self) -> None:
        """Empty the search box."""
        with self._panels.lock:
            set_value(self._text, "")
            self._suggestions.visible = False

    def show_message(self, text: str | None) -> None:
        """Show an error message; None hides it."""
        if text is not None:
            self._message.content = pages.warning(text)
        self._message.visible = text is not None

    def show_history(self) -> None:
        """Update the list of earlier prompts."""
        self._recent.options = (NO_PROMPT, *self._session.history.prompts)

    def show_legend(self) -> None:
        """Update mode and legend."""
        session = self._session
        set_value(self._mode, MODE_LABELS[session.mode])
        example = session.history.vocabulary[0]
        hint = (
            f"Type what you look for, such as “{example}”, and press Enter, or click an object in the scene."
        )
        self._legend.content = pages.legend(
            session.all_questions(), session.mode, session.coloring.scale, hint
        )

    def _submit(self, client: Any) -> None:
        time.sleep(0.06)  # the page sends the last keystroke up to 50 ms late
        self._panels.ask(self._text.value, client)

    def _suggest(self) -> None:
        history = self._session.history
        with self._panels.lock:  # keystrokes arrive on several threads; each reads the current text
            options = suggestions(self._text.value, history.prompts, history.vocabulary)
            if options:
                self._suggestions.options = tuple(options)
            self._suggestions.visible = bool(options)

    def _ask_again(self, client: Any) -> None:
        if self._recent.value != NO_PROMPT:
            self._panels.ask(self._recent.value, client)
            set_value(self._recent, NO_PROMPT)

    def _change_mode(self) -> None:
        label = self._mode.value
        with self._panels.lock:
            self._session.mode = next((mode for mode, name in MODE_LABELS.items() if name == label), "photo")
            self._panels.redraw()
            self.show_legend()
