"""The pages that `fieldlum watch` shows in a browser on site.

`follow` reads a session's files as they grow, `snapshot` makes plain tables of them, `access`
decides who may ask, `server` answers. The pages read a session's files alone: a capture that runs
does not know of them.
"""
