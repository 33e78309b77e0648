"""Tables, plots and pages, made from rows and nothing else.

`grid`, `latency` and `literature` each fill one `table.Table` and one `page.Page`; `facts` has
what they say of single tasks.
"""
