"""Capture: run the plan against a camera and a pyranometer, or import frames from a card.

`state` computes the state of each slot from the journal; `utc_clock` keeps UTC correct when the
computer's clock is set; `reconnect` reopens devices that fail; `logger` writes irradiance;
`bracket` takes one bracket; `runner` is the loop; `import_card` imports; `status` counts what is
done.
"""

from fieldlum.capture.options import Options, prepare
from fieldlum.capture.runner import run
