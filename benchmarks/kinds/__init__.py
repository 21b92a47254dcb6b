"""Problems of other kinds than those of the suite, written as a user would, and the suite's with other constants."""

from benchmarks.kinds.approaches import Chain, Gantry, Interceptor, Pursuit, Rendezvous, Unicycle
from benchmarks.kinds.compartments import Anaesthesia, HerdImmunity, LotkaVolterra, LynxAndHare, Rooms
from benchmarks.kinds.cycles import Flywheels, JetLag, PowerSwing, Runaway, Searchlight
from benchmarks.kinds.demands import Backburn, ChemoWard, IslandGrid, VaccineStock
from benchmarks.kinds.flights import Descent, Encounter
from benchmarks.kinds.journeys import Barge, Scooter, SolarCar
from benchmarks.kinds.lines import Casino, Gene, Tightrope, Uphill, Washboard
from benchmarks.kinds.machines import Converter, Detumble, Friction, MagLev
from benchmarks.kinds.markets import Endowment, Granary, Hedge, PairTrade
from benchmarks.kinds.masses import Crosswind, Gusty, Lander, Orbit, Servo, Sprint, VanDerPol
from benchmarks.kinds.mixtures import Bearing, Mirror, Mixture
from benchmarks.kinds.other_constants import OTHERS
from benchmarks.kinds.passages import FastRiver, Glider, SlotChange, StraitFerry, TackingYacht, TwoDoors, TwoLink
from benchmarks.kinds.plants import Epidemic, Investor, Reactor, Reservoir, Toggle, Tokens, TwoTanks
from benchmarks.kinds.stores import Chemostat, FastCharge, Ferment, Fishery, Forager
from benchmarks.kinds.swings import Duffing, LongWatch, MountainCar, QuietStance, Swingup
from benchmarks.kinds.vehicles import Bicycle, Evader, Loiter, Ring, River, Slalom, Steering, TwoCars, TwoHarbours
from benchmarks.kinds.waters import Convection, Drawbridge, Fjord, Levee, Minefield
from benchmarks.kinds.weather import Drone3, Storm, Tide
from pirl_rl import ReachAvoidProblem

__all__ = ["KINDS", "PROBLEMS", "Mixture"]

KINDS: tuple[type[ReachAvoidProblem], ...] = (Servo, Steering, Evader, Gusty, TwoTanks, Reservoir, Slalom, Orbit, Ring)
KINDS += (VanDerPol, TwoHarbours, River, Loiter, Crosswind, Bicycle, Tokens, Lander, Epidemic, Toggle, TwoCars, Sprint)
KINDS += (Investor, Runaway, JetLag, Searchlight, PowerSwing, Forager, Ferment, FastCharge, SlotChange, TwoLink)
KINDS += (Bearing, Mirror, Duffing, MountainCar, Swingup, Pursuit, Rooms, Anaesthesia)
KINDS += (LotkaVolterra, Chain, Unicycle, Rendezvous, FastRiver, Glider, Reactor, Fishery)
KINDS += (VaccineStock, Backburn, ChemoWard, IslandGrid, StraitFerry, QuietStance, LynxAndHare, HerdImmunity)
KINDS += (TackingYacht, Encounter, Descent, Gantry, Endowment, Granary, PairTrade, Chemostat)
KINDS += (SolarCar, Scooter, Barge, Tightrope, Casino, Washboard, Uphill, Gene)
KINDS += (Fjord, Drawbridge, Levee, Convection, Minefield, Flywheels, LongWatch, TwoDoors)
KINDS += (Friction, Converter, Storm, Interceptor, Hedge, MagLev, Detumble, Tide, Drone3)

PROBLEMS = {kind.__name__: kind for kind in KINDS} | OTHERS
