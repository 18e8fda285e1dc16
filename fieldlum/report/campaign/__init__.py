"""Write one overview of all rooms of a campaign; a room that cannot be read is named in it."""

from fieldlum.report.campaign.campaign_file import CampaignFile, CampaignRoom, read_campaign
