"""Many sessions as one campaign: every stage for each room, and one overview of all of them.

Rooms are independent: a failure in one is reported, and the other rooms continue.
"""

from fieldlum.campaign.campaign_file import read_campaign
from fieldlum.campaign.stages import run_stage
