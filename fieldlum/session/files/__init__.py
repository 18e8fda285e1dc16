"""Files that one stage writes and another reads: one module for each.

A file without a format version has version 1, as fieldlum 0.1.0 wrote it. Keys that a module does
not know are ignored, because newer versions may add keys.
"""
