"""The style sheet of the report: light and dark, wide and narrow, on screen and on paper."""

from __future__ import annotations

from hpid_ros.analysis.plot_style import GRID, INK, REFERENCE, RUN_STYLES

# The same hues as on paper, light enough for a dark page: line and tint of each run.
DARK_RUNS = (
    ("#6cb4ff", "#6cb4ff"),
    ("#ff9a52", "#7a4a2c"),
    ("#63d29b", "#2c5c47"),
    ("#c99bea", "#594070"),
    ("#ff8fa3", "#713d49"),
    ("#5fd4e6", "#2c5c66"),
    ("#d8bd5a", "#5d522a"),
    ("#aab6c4", "#4a525c"),
)

_LIGHT_VARIABLES = "".join(
    f"--run-{k}:{style.color};--tint-{k}:{style.tint};" for k, style in enumerate(RUN_STYLES)
)
_DARK_VARIABLES = "".join(
    f"--run-{k}:{color};--tint-{k}:{tint};" for k, (color, tint) in enumerate(DARK_RUNS)
)

_DARK = f"""
    --page: #14171c; --ink: #e6e9ee; --soft: #a2abb8; --line: #39404b; --panel: #1d2229;
    --grid: #2c323b; --reference: #5c6675; --better: #6fd198; --worse: #ff8f86;
    --selection: #6cb4ff44;
    {_DARK_VARIABLES}
"""

STYLE_SHEET = (
    f"""
:root {{
  color-scheme: light dark;
  --page: #ffffff; --ink: {INK}; --soft: #5b6472; --line: #d5d9e0; --panel: #f4f6f9;
  --grid: {GRID}; --reference: {REFERENCE}; --better: #14713d; --worse: #b3261e;
  --selection: #0b4a8f33;
  {_LIGHT_VARIABLES}
}}
@media screen and (prefers-color-scheme: dark) {{ :root:not([data-theme=light]) {{{_DARK}}} }}
@media screen {{ :root[data-theme=dark] {{{_DARK}}} }}
:root[data-theme=dark] {{ color-scheme: dark; }}
:root[data-theme=light] {{ color-scheme: light; }}
"""
    + """
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
main { max-width: 72rem; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .75rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .5rem; }
p { margin: .5rem 0; max-width: 46rem; overflow-wrap: anywhere; }
.answer {
  font-size: 1.15rem; padding: .9rem 1.1rem; background: var(--panel);
  border-left: 4px solid var(--run-1); max-width: none;
}
.warning { border-left: 4px solid var(--worse); padding: .4rem 1.1rem; }
.soft { color: var(--soft); font-size: .9rem; font-weight: 400; }
.scroll {
  overflow-x: auto; max-width: 100%; position: relative;
  scrollbar-width: thin; scrollbar-color: var(--soft) var(--panel);
}
.scroll.more-right { mask-image: linear-gradient(to left, transparent, #000 3.5rem); }
.scroll.more-left th[scope=row], .scroll.more-left thead th.text {
  box-shadow: inset -2px 0 var(--line);
}
.scroll.wide::before {
  content: "wider than the page: scroll sideways"; display: block; position: sticky; left: 0;
  width: max-content; max-width: 100%; font-size: .82rem; color: var(--soft);
}
.scroll + .scroll { margin-top: 1.5rem; }
sup { line-height: 0; }
table {
  border-collapse: separate; border-spacing: 0; font-size: .92rem;
  font-variant-numeric: tabular-nums;
}
th, td { padding: .3rem .6rem; text-align: right; white-space: nowrap; }
th { font-weight: 600; }
th[scope=row], .text { text-align: left; }
thead th { border-bottom: 1px solid var(--line); vertical-align: bottom; }
thead th.group { text-align: center; border-bottom: 0; }
td.first, th.first { padding-left: 1.6rem; }
tr { background: var(--page); }
th[scope=row], thead th.text { position: sticky; left: 0; background: inherit; }
tbody tr:nth-child(even) { background: var(--panel); }
tfoot th, tfoot td { border-top: 2px solid var(--line); font-weight: 700; }
.wrap td { white-space: normal; overflow-wrap: anywhere; text-align: left; min-width: 8rem; }
.wrap th { vertical-align: top; }
.better { color: var(--better); }
.worse { color: var(--worse); }
.unseen {
  position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%);
  white-space: nowrap;
}
header { display: flex; gap: 1rem; align-items: flex-start; justify-content: space-between; }
button {
  font: inherit; font-size: .9rem; color: var(--ink); background: var(--panel); cursor: pointer;
  border: 1px solid var(--line); border-radius: .35rem; padding: .2rem .6rem; min-height: 2rem;
}
button:hover { border-color: var(--soft); }
:focus-visible { outline: 2px solid var(--run-0); outline-offset: 2px; }
.theme { flex: none; }
[role=tablist] {
  display: flex; flex-wrap: wrap; gap: .35rem; margin: 2rem 0 0;
  border-bottom: 1px solid var(--line); position: sticky; top: 0; z-index: 2;
  background: var(--page); padding: .4rem 0;
}
[role=tab][aria-selected=true] { background: var(--ink); color: var(--page); }
[role=tabpanel] > h2 { margin-top: 1.25rem; }
details { margin: .5rem 0; }
summary { cursor: pointer; padding: .2rem 0; }
figure { margin: 0 0 2.5rem; }
.controls { display: flex; flex-wrap: wrap; gap: .4rem .75rem; align-items: center; }
.controls .zoom { margin-left: auto; display: flex; gap: .25rem; }
.run[aria-pressed=false] { opacity: .45; text-decoration: line-through; }
.swatch {
  display: inline-block; width: 1.8rem; border-top: 3px; margin-right: .4rem;
  vertical-align: middle;
}
.panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); }
.panels.single { grid-template-columns: 1fr; }
.panel { min-width: 0; padding: .35rem 0; }
.title { font-size: .9rem; overflow-wrap: anywhere; }
canvas { display: block; width: 100%; height: 11rem; touch-action: pan-y; cursor: crosshair; }
.single canvas { height: 17rem; }
output {
  display: block; min-height: 1.3rem; font-size: .82rem; color: var(--soft);
  font-variant-numeric: tabular-nums; overflow-wrap: anywhere;
}
figcaption { font-weight: 600; margin-bottom: .4rem; }
@media print {
  [role=tablist], .theme, .zoom { display: none; }
  section[hidden] { display: block !important; }
  .scroll { overflow: visible; mask-image: none !important; }
  .scroll.wide::before { display: none; }
  .scroll table { font-size: 9pt; }
  .scroll[data-columns="10"] table { font-size: 7pt; }
  .scroll[data-columns="14"] table { font-size: 5.5pt; }
  .scroll[data-columns="18"] table { font-size: 4pt; }
  .scroll[data-columns="26"] table { font-size: 2.8pt; }
  .scroll th, .scroll td { padding: .15em .5em; }
  .scroll th.text, .scroll td.text { white-space: normal; }
  thead { display: table-row-group; }
  .panel { break-inside: avoid; }
}
"""
)
