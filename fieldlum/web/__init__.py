"""Pages that `fieldlum watch` shows in a browser on site.

`follow` reads a session's files as they grow, `snapshot` turns them into plain tables, `access`
decides which requests are answered, and `server` answers them. The pages only read the files of a
session; with --control they also write notes, marks, pauses and extra slots, which a capture reads
(`control`). A capture never waits for the pages.
"""
