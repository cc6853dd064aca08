// Light or dark: what the browser prefers, or the choice kept in it. Runs before the first paint.

(() => {
  const KEY = "aerokit theme", WISHES = ["auto", "light", "dark"], SIGNS = { auto: "◐", light: "☀", dark: "☾" };
  const prefersLight = matchMedia("(prefers-color-scheme: light)");
  let wish = "auto";
  try { wish = localStorage.getItem(KEY) ?? wish; } catch { /* storage is blocked */ }

  function apply() {
    if (!WISHES.includes(wish)) wish = "auto";
    document.documentElement.dataset.theme = wish === "auto" ? (prefersLight.matches ? "light" : "dark") : wish;
    const button = document.getElementById("theme");
    if (!button) return;
    button.textContent = SIGNS[wish];
    button.title = wish === "auto" ? "Colours as the browser prefers" : `${wish} colours`;
    button.setAttribute("aria-label", button.title);
  }

  prefersLight.addEventListener("change", apply);
  document.addEventListener("DOMContentLoaded", () => {
    document.getElementById("theme").onclick = () => {
      wish = WISHES[(WISHES.indexOf(wish) + 1) % 3];
      try { localStorage.setItem(KEY, wish); } catch { /* storage is blocked */ }
      apply();
      dispatchEvent(new Event("resize")); // redraws the attitude
    };
    apply();
  });
  apply();
})();
