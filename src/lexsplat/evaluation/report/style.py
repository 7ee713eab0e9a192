"""The look of the report: one page that loads nothing, light and dark."""

from __future__ import annotations

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" 
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style></head>
<body><main>
{body}
</main></body></html>
"""

STYLE = """
:root{color-scheme:light dark;--ground:#fbfaf8;--panel:#fff;--ink:#1d1c22;--soft:#6d6a75;
  --line:#e6e3de;--accent:#c2410c}
@media(prefers-color-scheme:dark){:root{
  --ground:#131217;--panel:#1c1b22;--ink:#ecebf0;--soft:#9a97a5;
  --line:#2e2c37;--accent:#fb923c}}
*{box-sizing:border-box}
body{margin:0;background:var(--ground);color:var(--ink);
  font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1180px;margin:0 auto;padding:48px 24px 96px}
h1{font-size:34px;letter-spacing:-.02em;margin:0}
header p{color:var(--soft);margin:4px 0 24px}
h2{font-size:20px;letter-spacing:-.01em;margin:56px 0 16px}
section p{color:var(--soft);max-width:75ch}
.cards{display:flex;flex-wrap:wrap;gap:12px}
.card{background:var(--panel);border:1px solid var(--line);border-radius:12px;
  padding:14px 20px;min-width:128px}
.card b{display:block;font-size:26px;font-variant-numeric:tabular-nums;letter-spacing:-.02em}
.card span{display:block}
.card small{color:var(--soft)}
figure{margin:0}
img,.pic{display:block;width:100%;border-radius:8px;background-size:cover;
  print-color-adjust:exact;-webkit-print-color-adjust:exact}
figcaption{color:var(--soft);font-size:13px;margin-top:6px}
.hero{display:grid;grid-template-columns:repeat(auto-fit,minmax(220px,1fr));gap:12px;margin-top:32px}
.bar{display:flex;align-items:center;gap:10px;color:var(--soft);font-size:12px;margin-top:14px}
.bar i{flex:1;max-width:280px;height:8px;border-radius:4px}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;min-width:50%}
.scroll+.scroll{margin-top:1.5rem}
th,td{padding:7px 14px 7px 0;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{color:var(--soft);font-weight:500;font-size:13px}
th:first-child,td:first-child{text-align:left}
.facts td{text-align:left;white-space:normal;overflow-wrap:anywhere;vertical-align:top}
.facts td:first-child{overflow-wrap:normal;color:var(--soft)}
.meter{display:inline-block;width:72px;height:6px;border-radius:3px;background:var(--line);
  margin-right:10px;vertical-align:middle;overflow:hidden}
.meter i{display:block;height:100%;background:var(--accent)}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(160px,1fr));gap:18px}
.plot svg{display:block;width:100%}
.plot .grid{fill:none;stroke:var(--line);stroke-width:1}
.plot polyline{fill:none;stroke:var(--accent);stroke-width:1.6;stroke-linejoin:round}
.plot polygon{fill:var(--accent);opacity:.12}
.plot.mean polyline{stroke:var(--ink);stroke-width:2.2}
.plot b{color:var(--ink);float:right}
.legend{display:flex;flex-wrap:wrap;gap:6px 18px;font-size:13px;margin-bottom:14px}
.legend i{display:inline-block;width:18px;height:3px;border-radius:2px;background:var(--c);
  margin-right:7px;vertical-align:middle}
.plot polyline[class]{stroke:var(--c);stroke-width:1.4}
.plot.mean polyline[class]{stroke-width:1.8}
.s0{--c:#c2410c}
.s1{--c:#2563eb}
.s2{--c:#15803d}
.s3{--c:#9333ea}
.s4{--c:#0f172a}
.s5{--c:#0e7490}
.s6{--c:#be185d}
.s7{--c:#4d7c0f}
.s8{--c:#475569}
.s9{--c:#7c2d12}
@media(prefers-color-scheme:dark){.s0{--c:#fb923c}.s1{--c:#60a5fa}.s2{--c:#4ade80}.s3{--c:#c084fc}.s4{--c:#fde68a}
  .s5{--c:#22d3ee}.s6{--c:#f472b6}.s7{--c:#a3e635}.s8{--c:#94a3b8}.s9{--c:#fda4af}}
.versus{border-top:1px solid var(--line);padding:14px 0 22px}
.versus p{margin:0 0 8px;color:var(--ink);max-width:none}
.row{display:grid;grid-auto-flow:column;grid-auto-columns:minmax(130px,270px);gap:8px;overflow-x:auto}
.row.shared{max-width:560px;margin-bottom:12px}
.answer p{font-size:13px;margin:0 0 6px}
.answer p span{display:block;color:var(--soft);font-variant-numeric:tabular-nums}
.answer figure+figure{margin-top:6px}
.case{display:grid;grid-template-columns:repeat(5,1fr);gap:8px;margin-bottom:20px}
.case p{grid-column:1/-1;margin:0;color:var(--ink);max-width:none}
.case p span{float:right;color:var(--soft);font-variant-numeric:tabular-nums}
.case.head{color:var(--soft);font-size:13px;margin-bottom:4px}
@media(max-width:700px){.cases{overflow-x:auto}.case{width:680px}
  .case p span{float:none;margin-left:12px}}
details{margin:8px 0;background:var(--panel);border:1px solid var(--line);border-radius:10px;
  padding:10px 16px}
summary{cursor:pointer}
pre{overflow-x:auto;font-size:12px;color:var(--soft)}
"""
