"""Messages to people far away, and heartbeats to a monitor: sent in the background, never waited
for.
"""

from fieldlum.notify.heartbeat import Heartbeat, read_address
from fieldlum.notify.outbox import Message, Outbox, Post
from fieldlum.notify.targets import apprise_post, read_targets

__all__ = [
    "Heartbeat",
    "Message",
    "Outbox",
    "Post",
    "apprise_post",
    "read_address",
    "read_targets",
]
