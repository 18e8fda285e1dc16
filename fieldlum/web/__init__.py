"""Pages that `fieldlum watch` and `fieldlum scene click` show in a browser on site.

`server` answers requests that have the token; `snapshot` computes the tables of `watch` from the
session's growing files; `prediction_so_far` runs merge, pair, train and predict between brackets;
`click_room` is the page of `scene click`. A capture never waits for the pages.
"""
