"""Many sessions as one campaign: every stage for each room, and one overview of all of them.

Rooms are independent: what fails in one is named, and the others go on.
"""

from fieldlum.campaign.campaign_file import CampaignFile, CampaignRoom, read_campaign
from fieldlum.campaign.stages import RoomResult, run_stage

__all__ = ["CampaignFile", "CampaignRoom", "RoomResult", "read_campaign", "run_stage"]
