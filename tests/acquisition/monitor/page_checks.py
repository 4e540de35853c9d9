"""Scripts that look over a whole page for what a reader would stumble on; each comes to a list of what it found."""

from __future__ import annotations

POOR_CONTRAST = """
(() => {
  const linear = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
  const luminance = (colour) => {
    const [r, g, b] = colour.match(/[0-9.]+/g).map((text) => linear(Number(text) / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const colour = getComputedStyle(at).backgroundColor;
      if (!colour.startsWith("rgba(0, 0, 0, 0")) return colour;
    }
    return "rgb(255, 255, 255)";
  };
  const poor = [];
  for (const one of document.querySelectorAll("body *")) {
    const says = [...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!says || one.closest(".unseen, .skip, script, style, noscript, title, [hidden], :disabled")) continue;
    const style = getComputedStyle(one);
    const [a, b] = [luminance(one.closest("svg") ? style.fill : style.color), luminance(behind(one))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < 4.5) poor.push([one.tagName, one.id, one.textContent.slice(0, 30), ratio.toFixed(2)]);
  }
  return poor;
})()
"""
"""Texts whose contrast is below 4.5 : 1 (WCAG 2.2, success criterion 1.4.3, level AA)."""

TOO_WIDE = """
[...document.querySelectorAll("body *")]
  .filter((one) => one.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
  .filter((one) => !one.closest(".unseen, .skip, script, svg"))
  .map((one) => [one.tagName, one.id, one.className, one.getBoundingClientRect().right])
"""
"""Elements that reach beyond the window's right edge."""

NAMELESS = """
[...document.querySelectorAll("button, img, svg:not([aria-hidden]), [role=img], [role=group], section")]
  .filter((one) => !one.closest("[hidden]"))
  .filter((one) => !["aria-label", "alt", "aria-labelledby"].some((name) => one.getAttribute(name)))
  .filter((one) => !one.textContent.trim())
  .map((one) => one.outerHTML)
"""
"""Things to press or to look at that have no name for who cannot see them (WCAG 2.2, 1.1.1 and 4.1.2)."""

OUTSIDE = """
performance.getEntriesByType("resource").map((one) => one.name)
  .filter((name) => !name.startsWith("data:") && !name.startsWith(location.origin + "/"))
"""
"""Addresses elsewhere that the page has asked."""
