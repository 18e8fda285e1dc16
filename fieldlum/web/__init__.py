"""Pages that `fieldlum watch` and `fieldlum scene click` show in a browser on site.

`follow` reads a session's files as they grow, `snapshot` turns them into plain tables, `access`
decides which requests are answered, and `server` answers them. `answer` runs merge, pair, train and
predict between brackets. A capture never waits for the pages.
"""
