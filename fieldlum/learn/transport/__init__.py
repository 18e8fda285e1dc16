"""Light transport: linear in sky and sun, so that a room is learnt in closed form.

See docs/models/transport.md.
"""

from fieldlum.learn.transport.model import Transport, fit, from_state
