"""Known objects: model files, diameter, keypoints, surface points, symmetries, units."""

from depthpose.pose.mesh.mirror import is_mirror_alike as is_mirror_alike
from depthpose.pose.mesh.mirror import mirror_deviation as mirror_deviation
from depthpose.pose.mesh.models import exact_diameter as exact_diameter
from depthpose.pose.mesh.models import make_model as make_model
from depthpose.pose.mesh.models import mesh_suffixes as mesh_suffixes
from depthpose.pose.mesh.models import read_geometry as read_geometry
from depthpose.pose.mesh.models import read_model as read_model
from depthpose.pose.mesh.models import refuse_one_name as refuse_one_name
from depthpose.pose.mesh.near import NearSymmetry as NearSymmetry
from depthpose.pose.mesh.near import near_symmetries as near_symmetries
from depthpose.pose.mesh.near import true_symmetries as true_symmetries
from depthpose.pose.mesh.propose import SURE as SURE
from depthpose.pose.mesh.propose import SymmetryProposal as SymmetryProposal
from depthpose.pose.mesh.propose import propose_symmetries as propose_symmetries
from depthpose.pose.mesh.propose import symmetries_from_proposals as symmetries_from_proposals
from depthpose.pose.mesh.propose import with_found_symmetries as with_found_symmetries
from depthpose.pose.mesh.sampling import estimate_normals as estimate_normals
from depthpose.pose.mesh.sampling import farthest_points as farthest_points
from depthpose.pose.mesh.sampling import gap_to_surface_m as gap_to_surface_m
from depthpose.pose.mesh.sampling import sample_surface as sample_surface
from depthpose.pose.mesh.symmetry import symmetries_from_bop as symmetries_from_bop
from depthpose.pose.mesh.symmetry import symmetries_to_bop as symmetries_to_bop
from depthpose.pose.mesh.symmetry import symmetry_transforms as symmetry_transforms
from depthpose.pose.mesh.symmetry import turn_about as turn_about
from depthpose.pose.mesh.units import unit_advice as unit_advice
