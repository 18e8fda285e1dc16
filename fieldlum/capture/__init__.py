"""Capture: run the plan against a camera and a pyranometer, or import frames from a card.

`runner` is the loop over slots; `bracket` takes one bracket, and `frame_checks` checks its frames;
`irradiance_log` logs the pyranometer; `disk_writer` writes the journal and rows; `reconnect` opens
devices again that fail; `steady_clock` keeps UTC correct when the computer's clock is set; `notify`
sends messages; `doctor` checks everything before a campaign. `import_card` imports frames, which
`match_card` matches to slots, and `import_logger` irradiance. The state of each slot is computed by
`fieldlum.session.slot_states`.
"""

from fieldlum.capture.runner import Options, prepare, run
