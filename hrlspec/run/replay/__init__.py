"""Episodes as one page that plays them, with what both levels thought: `data` makes the record, `page` the HTML."""
