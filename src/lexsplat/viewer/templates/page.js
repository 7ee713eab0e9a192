// viser has no setting for the title of the page, for a placeholder, or for the accessible names of its controls.
document.title = {{ title | tojson }};
const nameControls = () => {
  for (const label of document.querySelectorAll("label[for]")) {
    if (!label.textContent || label.control) continue;
    const row = label.parentElement?.parentElement?.parentElement;
    for (const control of row?.querySelectorAll("input, textarea, [role=slider]") ?? []) {
      if (!control.hasAttribute("aria-label")) control.setAttribute("aria-label", label.textContent);
      if (label.textContent === "Find" && control.matches("input")) control.placeholder = {{ placeholder | tojson }};
    }
  }
};
new MutationObserver(nameControls).observe(document.body, { childList: true, subtree: true });
nameControls();
