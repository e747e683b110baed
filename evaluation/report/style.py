"""The style sheet of a report: light for paper, dark where the reader's system is."""

from evaluation.report.figures.palette import COLOURS, COLOURS_ON_DARK

_RULES = """
:root{--paper:#fff;--ink:#1a1a1a;--quiet:#5c5c5c;--line:#e4e4e4;--soft:#f6f6f4;--rule:#1a1a1a;--zero:#8a8a8a;
--reference:#b4b4b4;--best:#eef4ea;color-scheme:light dark}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,"Liberation Sans",sans-serif}
main{max-width:1160px;margin:0 auto;padding:40px 28px 72px}
h1{font-size:30px;line-height:1.2;font-weight:650;letter-spacing:-.015em;margin:0 0 6px;overflow-wrap:anywhere}
h2{font-size:21px;font-weight:650;letter-spacing:-.01em;margin:56px 0 4px;padding-top:18px;
border-top:2px solid var(--rule);
overflow-wrap:anywhere}
h3{font-size:15px;font-weight:650;margin:34px 0 0}
p{margin:4px 0 10px}
a{color:inherit;text-decoration-color:var(--quiet);text-underline-offset:2px}
.about{color:var(--quiet);overflow-wrap:anywhere}
.name{unicode-bidi:isolate;overflow-wrap:anywhere}
nav ul{list-style:none;display:flex;flex-wrap:wrap;gap:2px 18px;padding:0;margin:12px 0 0}
pre{margin:10px 0;padding:10px 14px;background:var(--soft);border-radius:4px;overflow-x:auto;
font:12.5px/1.5 ui-monospace,"SF Mono",Menlo,Consolas,"Liberation Mono",monospace;
white-space:pre-wrap;overflow-wrap:anywhere}
.remark{border-left:3px solid var(--zero);background:var(--soft);padding:8px 14px;margin:12px 0;overflow-wrap:anywhere}
.table,details{margin:22px 0}#settings details{margin:6px 0}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:13.5px;line-height:1.35;font-variant-numeric:tabular-nums;min-width:min(100%,420px);
border-bottom:1.5px solid var(--rule)}
caption{text-align:left;padding:0 0 7px;font-size:13.5px}
thead{border-top:1.5px solid var(--rule);border-bottom:.75px solid var(--rule)}
th,td{padding:6px 10px;text-align:left;vertical-align:top;font-weight:400}
thead th{font-weight:600;vertical-align:bottom}
thead th.group{text-align:center;border-bottom:.75px solid var(--zero);padding-bottom:3px}
thead th.number{padding-right:22px}
th:first-child{padding-left:2px;position:sticky;left:0;background:var(--paper);z-index:1}
tbody tr+tr{border-top:.75px solid var(--line)}
.method{display:flex;align-items:baseline;white-space:nowrap}
.method.long{white-space:normal;min-width:170px;max-width:330px}
tbody td:not(.number){min-width:150px;max-width:420px;overflow-wrap:anywhere}
.dense{font-size:12.5px}.dense td,.dense th{padding-left:5px;padding-right:5px}.dense td.number{padding-right:2px}
.dense thead th.number{padding-right:14px}.dense .star{width:12px}
.number{text-align:right;white-space:nowrap}
td.number{padding-right:8px}
.unit{display:block;white-space:nowrap;color:var(--quiet);font-weight:400;font-size:12px}
.star{display:inline-block;width:14px;text-align:right;font-size:10px;vertical-align:1.5px}
.best{background:var(--best)}
.small{display:block;color:var(--quiet);font-size:12px;white-space:normal;overflow-wrap:anywhere}
td.number .small{white-space:nowrap;padding-right:14px}
tr.published{font-style:italic}
.note{color:var(--quiet);font-size:12.5px;margin:6px 0 0;max-width:80ch}
summary{cursor:pointer;font-size:13.5px}
details[open] summary{margin-bottom:8px}
figure{margin:30px 0 34px}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:3px 20px;margin:0 0 8px;padding:0;font-size:13px}
.legend li{display:flex;align-items:center;gap:7px;min-width:0}
.swatch{flex:none;vertical-align:-1px;overflow:visible}
tbody th .swatch{margin-right:8px;align-self:center}
.panels{display:grid;gap:14px 26px;align-items:start}
.stack{display:grid;gap:14px}
.panels-1{grid-template-columns:minmax(0,820px)}
.panels-2{grid-template-columns:repeat(auto-fit,minmax(min(100%,430px),1fr))}
.panels-3{grid-template-columns:repeat(auto-fit,minmax(min(100%,290px),1fr))}
.panel{width:100%;max-width:700px;height:auto;display:block}
figcaption{font-size:13px;color:var(--quiet);max-width:100ch;margin-top:6px}
figcaption b{color:var(--ink)}
text{fill:var(--ink)}
text.quiet{fill:var(--quiet);paint-order:stroke;stroke:var(--paper);stroke-width:2.5px;stroke-linejoin:round}
.grid{stroke:var(--line)}.axis{stroke:var(--quiet)}.zero{stroke:var(--zero)}
.reference{stroke:var(--reference)}.start,.lost-cross,.whisker{stroke:var(--ink)}.lost-block{fill:var(--ink)}
.marker{stroke:var(--paper);stroke-width:.7px}
.curve:hover>path:not(.marker):not(.lost-halo){stroke-width:3px}
.area,.panel{font-variant-numeric:tabular-nums}
footer{margin-top:56px;padding-top:10px;border-top:.75px solid var(--line);color:var(--quiet);font-size:12.5px}
"""
_DARK = """:root{--paper:#15171a;--ink:#ececec;--quiet:#a3a6aa;--line:#2c3036;--soft:#1e2125;--rule:#cfcfcf;
--zero:#6d7278;--reference:#62676d;--best:#1f2b22}"""
_PRINT = """@page{size:A4;margin:14mm}
body{font-size:10.5pt}main{max-width:none;padding:0}
.scroll{overflow:visible}table{font-size:7.5pt}.dense{font-size:6.8pt}th,td,.dense th,.dense td{padding:2px 3px}
.small,.unit{font-size:6.5pt}.star{width:8px;font-size:6pt}tbody td:not(.number){min-width:0}
.dense thead th.number,.dense td.number{padding-right:2px}.swatch{width:24px}th:first-child{position:static}
figure,tr,.remark{break-inside:avoid}h2,h3,caption{break-after:avoid}
.panels-2{grid-template-columns:1fr 1fr}.panels-3{grid-template-columns:1fr 1fr 1fr}
*{print-color-adjust:exact;-webkit-print-color-adjust:exact}nav{display:none}"""


def style_sheet() -> str:
    """CSS for a page of a report; paper stays light whatever the system."""
    light = "".join(f".s{i}{{stroke:{colour}}}.f{i}{{fill:{colour}}}" for i, colour in enumerate(COLOURS))
    dark = "".join(f".s{i}{{stroke:{colour}}}.f{i}{{fill:{colour}}}" for i, colour in enumerate(COLOURS_ON_DARK))
    return (
        f"{_RULES}{light}\n@media screen and (prefers-color-scheme:dark){{{_DARK}{dark}}}\n@media print{{{_PRINT}}}\n"
    )
