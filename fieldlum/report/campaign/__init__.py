"""Run stages for many sessions, and write one overview of all rooms.

Rooms are independent: a failure in one room is reported, and the other rooms continue.
"""

from fieldlum.report.campaign.campaign_file import read_campaign
from fieldlum.report.campaign.stages import run_stage
