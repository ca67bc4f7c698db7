"""A trained agent to be tried by hand: `game` plays, `requests` reads what is asked, `server` serves a page for it."""
