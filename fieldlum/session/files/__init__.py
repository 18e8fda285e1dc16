"""Files that one stage writes and another reads: one module and one frozen dataclass for each.

Every reader and writer of such a file uses its module. A file without a format version has version
1, which fieldlum 0.1.0 wrote. Keys that a module does not know are additions and are ignored; known
keys are checked strictly.
"""
