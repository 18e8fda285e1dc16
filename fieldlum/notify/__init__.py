"""Send messages to users and heartbeats to a monitor, in the background."""

from fieldlum.notify.heartbeat import Heartbeat, read_address
from fieldlum.notify.outbox import Message, Outbox, Post
from fieldlum.notify.targets import apprise_post, read_targets
