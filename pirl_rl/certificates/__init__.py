"""Statistical certificates of a frozen policy: exact bounds from independent paths, in any number of dimensions.

A certificate says what the deployed policy does, in the simulator with its held controls. It is no statement about the
SDE under continuous feedback.
"""

from pirl_rl.certificates.band import ValueBand
from pirl_rl.certificates.bounds import lower_bound, order_of_quantile, upper_bound
from pirl_rl.certificates.certificate import CLAIMS, Certificate, certify, make_certifiers
from pirl_rl.certificates.claim import Claim, Level
from pirl_rl.certificates.corollary import diagnose
from pirl_rl.certificates.deployed import Deployed, LawOfStarts, OneStart, Starts
from pirl_rl.certificates.diagnostic import Diagnostic
from pirl_rl.certificates.sequence import anytime_lower_bound, anytime_upper_bound
from pirl_rl.certificates.success import SuccessBound
from pirl_rl.certificates.threshold import SafeThreshold

__all__ = [
    "CLAIMS",
    "Certificate",
    "Claim",
    "Deployed",
    "Diagnostic",
    "LawOfStarts",
    "Level",
    "OneStart",
    "SafeThreshold",
    "Starts",
    "SuccessBound",
    "ValueBand",
    "anytime_lower_bound",
    "anytime_upper_bound",
    "certify",
    "diagnose",
    "lower_bound",
    "make_certifiers",
    "order_of_quantile",
    "upper_bound",
]
