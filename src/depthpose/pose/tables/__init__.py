"""Tables 3.1, 3.2 and 3.3 of the thesis: published rows, and ours beside them."""

from depthpose.pose.tables.objects import join_by_object as join_by_object
from depthpose.pose.tables.published import LINEMOD as LINEMOD
from depthpose.pose.tables.published import PEERS as PEERS
from depthpose.pose.tables.published import ROWS as ROWS
from depthpose.pose.tables.published import TITLES as TITLES
from depthpose.pose.tables.published import PublishedRow as PublishedRow
from depthpose.pose.tables.voting import VotingCase as VotingCase
from depthpose.pose.tables.voting import cases_of as cases_of
from depthpose.pose.tables.voting import compare_voting as compare_voting
