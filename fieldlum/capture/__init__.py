"""Capture: run the plan against a camera and a pyranometer, or import frames from a card.

`steady_clock` keeps UTC correct when the computer's clock is set; `reconnect` reopens devices that
fail; `logger` writes irradiance; `bracket` takes one bracket; `runner` is the loop; `import_card`
imports. The state of each slot is computed by `fieldlum.session.slot_states`.
"""

from fieldlum.capture.runner import Options, prepare, run
