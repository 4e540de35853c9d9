"""How the pages look: light or dark as the reader's system is, one column on a phone, no file beside the page."""

from __future__ import annotations

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #22262b; --soft: #5b636d; --line: #e3e6ea; --panel: #f6f7f9;
  --good: #2f8f46; --remark: #b88600; --bad: #c8382e; --link: #1b5fb8 }
@media (prefers-color-scheme: dark) { :root { --paper: #15181c; --ink: #e4e7eb; --soft: #a0a8b2; --line: #343a42;
  --panel: #1e2227; --good: #55b56c; --remark: #e0b03a; --bad: #ef6a5e; --link: #79b0f5 } }
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 1100px;
  margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .2rem } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem }
a { color: var(--link) }
table { border-collapse: collapse; font-size: .95rem; width: 100% } th { text-align: left; font-weight: 600 }
td, th { padding: .25rem 1.2rem .25rem 0; border-bottom: 1px solid var(--line); vertical-align: top }
td { font-variant-numeric: tabular-nums } .note, figcaption { color: var(--soft); font-size: .9rem }
code { font-size: .9em; overflow-wrap: anywhere; background: var(--panel); padding: 0 .25em; border-radius: 3px }
.verdict { font-size: 1.15rem; font-weight: 600; padding: .5rem .8rem; margin: 1rem 0; border-left: 6px solid;
  background: var(--panel) }
.accept { border-color: var(--good) } .remark { border-color: var(--remark) } .refuse { border-color: var(--bad) }
td.accept, td.remark, td.refuse { border-color: var(--line); border-left: 4px solid; padding-left: .6rem;
  white-space: nowrap }
td.accept { border-left-color: var(--good) } td.remark { border-left-color: var(--remark) }
td.refuse { border-left-color: var(--bad); font-weight: 600 }
td.number { white-space: nowrap } figure { margin: 0 }
img { display: block; max-width: 100%; height: auto; background: #fff; border-radius: 4px; margin-bottom: .4rem }
@media (prefers-color-scheme: dark) { img { filter: brightness(.9); padding: 2px } }
details { border: 1px solid var(--line); border-radius: 6px; margin: .8rem 0; padding: 0 .9rem }
details[open] { padding-bottom: .9rem }
summary { cursor: pointer; font-weight: 600; font-size: 1.05rem; padding: .55rem 0 }
summary .note { font-weight: 400; margin-left: .6rem }
details h2 { font-size: 1.02rem; margin: 1.6rem 0 .4rem }
ul.todo { padding-left: 1.2rem; margin: .4rem 0 }
@media (max-width: 700px) {
  body { margin: 1rem auto; font-size: 15px } details { padding: 0 .6rem }
  table, tbody { display: block } tr { display: block; padding: .5rem 0; border-bottom: 1px solid var(--line) }
  tr.head { display: none }
  td, th { display: block; border: 0; padding: .05rem 0; white-space: normal }
  td[data-name]:not(:empty)::before { content: attr(data-name) ": "; color: var(--soft); font-size: .85rem }
  td:empty { display: none } td.number { white-space: normal } td.accept, td.remark, td.refuse { white-space: normal }
  figure.picture { overflow-x: auto } figure.picture img { min-width: 560px }
}
"""
"""The style sheet of a table's and a comparison's pages. Pictures keep a white ground in the dark: their colours are a
scale, which inverting would turn round."""
