"""CSS style of reports, for light and dark mode and for narrow and wide screens."""

STYLE = """
:root {
  color-scheme: light dark;
  --page: #f6f7f9; --card: #ffffff; --ink: #1b2130; --soft: #5d6675; --line: #e3e7ed; --accent: #6a3d78;
  --c0: #6a3d9a; --c1: #1f78b4; --c2: #33a02c; --c3: #e36f0a; --c4: #d42a5b; --c5: #7a6a53;
  --yes: #1d8348; --no: #b4311f;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #12151b; --card: #1b2028; --ink: #e8ebf0; --soft: #9ba5b4; --line: #2d3440; --accent: #cfa3dd;
    --c0: #b794e0; --c1: #6db7e8; --c2: #7fd07a; --c3: #f5a352; --c4: #f27a9b; --c5: #c9b491;
    --yes: #6fce97; --no: #f08b7c;
  }
}
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body {
  margin: 0; background: var(--page); color: var(--ink); -webkit-font-smoothing: antialiased;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif;
}
header, main { max-width: 1240px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 56px; }
h1 { margin: 0 0 8px; font-size: clamp(28px, 4vw, 42px); line-height: 1.15; letter-spacing: -0.02em; }
h2 { margin: 0 0 12px; font-size: 22px; letter-spacing: -0.01em; }
p { margin: 0 0 14px; max-width: 76ch; color: var(--soft); }
header p { font-size: 18px; }
nav { display: flex; flex-wrap: wrap; gap: 8px; margin: 20px 0 28px; }
nav a {
  padding: 4px 12px; border: 1px solid var(--line); border-radius: 999px; background: var(--card);
  color: var(--accent); font-size: 14px; text-decoration: none;
}
nav a:hover { border-color: var(--accent); }
section {
  margin: 0 0 24px; padding: 28px;
  border: 1px solid var(--line); border-radius: 16px; background: var(--card);
}
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 20px 28px; }
.figures div { padding-left: 14px; border-left: 3px solid var(--accent); }
.figures strong { display: block; font-size: 30px; line-height: 1.2; letter-spacing: -0.02em; }
.figures span { display: block; font-weight: 500; }
.figures small { color: var(--soft); }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(230px, 1fr)); gap: 18px; }
.pictures.fixed { grid-template-columns: repeat(var(--columns), minmax(0, 1fr)); align-items: end; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 20px; }
figure { position: relative; margin: 0; }
img { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: 10px; }
figcaption { margin-top: 6px; color: var(--soft); font-size: 14px; line-height: 1.4; }
.tag {
  position: absolute; top: 10px; left: 10px; padding: 1px 9px; border-radius: 999px;
  background: rgb(20 24 32 / 78%); color: #fff; font-size: 12px; font-weight: 600; letter-spacing: 0.02em;
}
.scroll { overflow-x: auto; }
table {
  min-width: min(100%, 560px); border-collapse: collapse; font-size: 15px; font-variant-numeric: tabular-nums;
}
th { text-align: left; color: var(--soft); font-size: 13px; font-weight: 600; }
th, td { padding: 8px 12px 8px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
tbody tr:last-child td { border-bottom: 0; }
td.number { text-align: right; padding-right: 28px; white-space: nowrap; font-weight: 500; }
th.number { text-align: right; padding-right: 28px; }
td.yes { color: var(--yes); } td.no { color: var(--no); }
td.meaning { min-width: 260px; color: var(--soft); }
.chart { display: block; width: 100%; height: auto; }
.chart text { fill: var(--soft); font-size: 13px; }
.chart .tick.y, .chart .legend { text-anchor: end; }
.chart .tick.x, .chart .label, .chart .empty { text-anchor: middle; }
.chart .legend { fill: var(--ink); }
.chart .grid { stroke: var(--line); }
.chart .axis { stroke: var(--soft); }
.chart polyline { fill: none; stroke-width: 2.2; stroke-linejoin: round; stroke-linecap: round; }
.chart .faint { stroke-width: 1; opacity: 0.28; }
.series-0 { stroke: var(--c0); } rect.series-0, circle.series-0 { fill: var(--c0); }
.series-1 { stroke: var(--c1); } rect.series-1, circle.series-1 { fill: var(--c1); }
.series-2 { stroke: var(--c2); } rect.series-2, circle.series-2 { fill: var(--c2); }
.series-3 { stroke: var(--c3); } rect.series-3, circle.series-3 { fill: var(--c3); }
.series-4 { stroke: var(--c4); } rect.series-4, circle.series-4 { fill: var(--c4); }
.series-5 { stroke: var(--c5); } rect.series-5, circle.series-5 { fill: var(--c5); }
@media (max-width: 720px) {
  section { padding: 18px; }
  .pictures.fixed { grid-template-columns: repeat(min(2, var(--columns)), minmax(0, 1fr)); }
}
@media print { nav { display: none; } section { break-inside: avoid; } }
"""
