"""Send messages to users and heartbeats to a monitor, in the background."""

from fieldlum.capture.notify.heartbeat import Heartbeat, read_address
from fieldlum.capture.notify.outbox import Message, Outbox, Post
from fieldlum.capture.notify.targets import apprise_post, read_targets
