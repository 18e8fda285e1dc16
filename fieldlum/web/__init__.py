"""Pages that `fieldlum watch` and `fieldlum scene click` show in a browser on site.

`snapshot` reads a session's files as they grow into plain tables, and `server` answers the requests
that it allows. `prediction_so_far` runs merge, pair, train and predict between brackets. A capture
never waits for the pages.
"""
