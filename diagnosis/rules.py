"""The numbers that decide what a diagnosis says.

Evidence is in nats: natural logarithms of likelihood ratios. `results/loop/rules.md` shows what each number buys.
"""

# Chance that a diagnosis of a recording that lacks nothing names an effect, over all candidates together. Each effect
# of the catalogue has an equal share of it, divided among the places and frequencies where it may be.
FALSE_ALARM = 0.005
# Chance that such a diagnosis finds something without a name.
FALSE_DOUBT = 0.005
# Nats by which something without a name must be better than named effects in their place to cast doubt on them: that an
# effect has a name makes it so much likelier before anything is read.
NAMED = 5.0
# Nats that an effect must bring besides if it has a number of its own for every site or bond: it does the work of many
# others.
STAND_IN = 10.0
STAND_INS = frozenset({"disorder", "unequal-bonds"})
# A wave or a pulse has to stand out from its surroundings: its price is as many times as high as others beside it win
# what noise lets them, for where an equation misfits, every frequency or time near by wins something. Beside a wave are
# those from so many steps of half a resolution away, where a line has fallen to a hundredth, up to so many; beside a
# pulse are as many of its width that are at least so many widths away. Of fewer the median says nothing; that of the
# others counts beyond the quantile to which noise brings it with this chance: of two dozen it scatters by a half.
LINE, AROUND, APART, FEW_AROUND, CROWDED = 4, 24, 4.0, 8, 0.975
# Stretches of the recordings whose numbers are compared: where they differ by more than the noise lets them, all
# evidence is that much less. Twice as many can hold twice the evidence of what is no noise; a few periods must fit in.
STRETCHES = 32
# The zero of a sensor wanders more slowly than the sites swing: at the main frequency its power is at most so many
# times that of the other noise. A faster one would follow whatever a wrong equation leaves.
SLOWER = 10.0
# Models that are carried to the next horizon.
RIVALS = 3
# Where all of these have influences with a frequency, a time or a delay of their own, the best model without goes with
# them if it is at most so many nats behind. It is named if it forecasts better by more nats than it is behind (as if
# forecasts left white noise) and leaves of them at most BEYOND_NOISE times the noise.
PLAINER = 30.0
# The best model with at least two effects less than each of these goes along, too, if it is at most so many nats
# behind: on short horizons several effects may do what one does, and a little more.
LEANER = 30.0
# Candidates of each model that are fitted in full, those of the highest score first.
TRIED = 4
# A score is linear: a candidate may bring so many times what its score says.
UNDERSTATED = 2.0
# Effects in a model, at most.
MOST_EFFECTS = 8
# Effects that come within so many nats of the one that is named, a nat for each number more, cannot be told from it by
# these readings.
EQUAL = 3.0
# Influences with a frequency or a time of their own are looked for on horizons of so many periods of the main
# frequency: on shorter ones they stand in for whatever is missing. Where a sensor shows plainly that something is
# still missing, or where no model can be followed further, they are looked for at once.
PERIODS = 3.0
# Horizons begin at this share of the shortest period, or of 2 pi over the fastest rate of change if that is less, where
# a wrong equation can follow, too.
FIRST_HORIZON = 0.5
# A sensor's rate of change counts there if it swings by at least this share of what the liveliest one does: smoothed
# noise of a sensor at rest changes fast.
MOVES = 0.1
# Columns may be in another order than the sites, and sensors of longer chains look from the other side, where so the
# declared equation leaves less than this share of what it leaves otherwise, in the work of forces. In the right order
# of recordings as of the suite `laboratory`, whatever they lack, no other one leaves less at all. One more exchange, or
# sensor, is worth it if it leaves less than the second share.
EXCHANGED, OTHERWISE = 0.5, 0.9
# Where the declared equation leaves less than so many times the noise of whole recordings, the search begins there:
# what is missing is weak, and short horizons would only offer stand-ins.
AT_ONCE = 1.5
# Pieces grow so many times from one horizon to the next, and faster where that changed nothing and the model follows
# the readings (`LOST`): what happens at a few times only is found while most pieces are without. Beyond this share of
# the record they are the record.
GROWTH, FASTER, ALMOST = 2, 4, 0.6
# Periods of the longest pieces where the ends are unknown: the curves of the outer sites have numbers of their own in
# each, so that work grows as the square of a piece's length.
BORDER = 16.0
# A residual beyond so many times the noise that the readings themselves show is not followed, unless it is less than
# this share of the swing: no equation of a laboratory is right to the last digit of an encoder.
LOST, FOLLOWED = 3.0, 0.01
# Where even what is new from one reading to the next is beyond it, what is left is not noise, and nats say little: an
# effect counts if it takes away this share of what is left (of its root mean square), an influence with a frequency or
# a time of its own if it takes half of it: a misfit swings as the motion does.
SHARE, SHARE_TIMED = 0.1, 0.5
# Nats that a chain costs in which neighbours push each other away. In a linear chain of two it is the mirror image of
# one whose second sensor looks from the other side; of the two, that is what laboratories have.
REPELLING = 30.0
# A motion that is farther from its zero than the readings are from theirs, by d times its swing, costs so many times
# ln(1 + d^2) nats: Cauchy's prior for where the zero is. A curved scale that is looked at from afar is another gain.
DISPLACED = 1.0
# A force with a frequency or a time of its own that pushes d times as hard as all else costs so many times ln(1 + d^2)
# nats: Cauchy's prior for its size. Far above the chain's own frequencies a force must push so hard to do what a small
# hum of a sensor does. A mass that is not read costs as much where it swings d times as far as its site.
PUSHED = 1.0
# Nats that a part of the noise which all sensors have in common must win beyond Schwarz' penalty (Ann. Stat. 6, 461,
# 1978): without it a camera that shakes is a force on all sites, and with it a misfit could pass for noise.
IN_COMMON = 2.0
# Nats that a white part of the noise beside a slow one must win beyond Schwarz' penalty: a zero that comes and goes
# beside an amplifier's hiss is no force, but both together could do the work of a weak one.
BESIDE_WHITE = 2.0
# A lattice is held where nothing moves for so many periods of its main frequency as a recording begins or ends, and a
# sensor reads something else than in the mean of the motion, by this share of its standard deviation. A free swing is
# gone from its turning point within a quarter of a period.
HELD, AWAY = 0.25, 0.1
# A forecast is worse where its error grows by more than this share of itself and is more than so many times the noise:
# with fewer readings every number more costs a little.
WORSE, BEYOND_NOISE = 0.05, 2.0
