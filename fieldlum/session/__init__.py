"""The session folder on disk: its paths, the formats of its files, and its locks.

`folder` has the paths, `core.files` writes complete files or nothing; `plan_file`,
`journal` and `day_files` define formats; `codec` reads and writes records as JSON, csv and npz;
`files` has the files that one stage writes and another reads.
"""

from fieldlum.core.files import (
    check_writable,
    disk_is_full,
    remove_scraps,
    replacing,
    replacing_path,
    sha256,
    sync_folder,
    write_file,
)
from fieldlum.session.day_files import DAY_COLUMNS, DayFiles, day_files, encode_sample, read_day
from fieldlum.session.folder import (
    DEFAULT_GRACE_S,
    Session,
    create_session,
    open_session,
    sole_user,
    update_session,
)
from fieldlum.session.journal import Journal, mark_slot, marks, read_journal
from fieldlum.session.plan_file import PLAN_COLUMNS, exposure_text, read_plan, write_plan
