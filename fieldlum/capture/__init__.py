"""Capture: run the plan against a camera and a pyranometer, lose nothing; or adopt what a card
holds.

`state` folds the journal into what is owed; `steady` keeps time through clock steps; `keeper`
reopens devices that fail; `logger` writes irradiance; `bracket` takes one bracket; `runner` is the
loop; `adopt` imports; `status` counts.
"""

from fieldlum.capture.runner import Options, prepare, run

__all__ = ["Options", "prepare", "run"]
