"""Tables, plots and pages, made from rows and nothing else.

`grid`, `latency` and `literature` each fill one `table.Table` and one `page.Page`. What they say of
single tasks is what those declare (`core/quality.py`).
"""
