// Light or dark.

/** As chosen before, else as the system has it. */
export function firstTheme(): void {
  let stored: string | null = null;
  try {
    stored = localStorage.getItem("lexsplat-theme");
  } catch {
    // a page from a file may not store anything
  }
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  document.documentElement.dataset.theme = stored === "light" || stored === "dark" ? stored : system;
}

/** Light if it was dark, else dark; returns the color behind the picture. */
export function changeTheme(): string {
  const name = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = name;
  try {
    localStorage.setItem("lexsplat-theme", name);
  } catch {
    // a page from a file may not store anything
  }
  return ground();
}

/** The color behind the picture. */
export function ground(): string {
  return getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();
}
