"""Every constant of the tracker that decides something, with its source or the measurement that set it.

"Measured" marks values that were set on signals of ``benchmarks/track_honesty.py``, with an earlier form of this
tracker. What has neither that mark nor a source is a choice; the benchmark tests all of them together. Constants of the
compiled fit are in :mod:`ctid_cli.tones.tone_kernels`.
"""

# --- what is asked for ----------------------------------------------------------------------------------------------

#: Name of the method in files.
METHOD = "tone_windows"
#: A row is accurate if its standard error is at most this share of the frequency, unless another limit is given.
USUAL_ACCURACY = 0.001
#: Most tones that can be asked for, and lines that are fitted in one window: 321 equations. A low string of a guitar
#: shows 45 of them at once. Measured.
MOST_ASKED = 64
MOST_LINES = 64
#: Rows of a track if nobody says how many: what a figure shows.
USUAL_ROWS = 1000
#: Most lines that are named as missing.
MOST_MISSING = 5
#: Share of the Nyquist frequency above which a tone may be the image of one that the sampling has folded.
SUSPICIOUS = 0.9

# --- record ---------------------------------------------------------------------------------------------------------

#: Fewest samples that show anything: half of the shortest window.
FEWEST = 32
#: A signal that varies by less than this share of itself is constant: rounding of double precision is 2e-16.
CONSTANT = 1e-12
#: Fourth powers of smaller or larger samples would vanish or overflow.
SMALLEST_SAMPLE = 1e-60
LARGEST_SAMPLE = 1e60
#: Noise that is added, as a share of the largest sample: far above rounding, far below 16 bits.
DITHER = 1e-7
#: A spike is so many times the largest of so many samples on each side, the two next to it left out; records with a
#: larger share of such samples are made of pulses.
SPIKE_TIMES = 6.0
SPIKE_AROUND = 64
SPIKE_WIDTH = 2
MOST_SPIKES = 0.01
#: Records are thinned to no fewer samples: then the fit of 60 s takes a second.
FEWEST_KEPT = 2**15
#: Of a thinned record this share of the band is kept, the highest line lies within the second one, and what would fold
#: into the band is lowered by the third [dB]: below the local noise level of 60 dB records.
KEPT_BAND = 0.9
TONE_BAND = 0.8
STOP_BAND = 60.0
#: Points of the response of the low-pass for each of its samples; lines between them are off by 1.3e-5.
RESPONSE_PADDING = 32
#: Gaps shorter than this share of the shortest period are bridged before a filter: a line is off by 1 % there.
BRIDGED = 0.05
#: Shortest segment in which the highest line is looked for; noise shows one in so many records.
SHORTEST_SEGMENT = 1024
FALSE_LINES = 1e-3

# --- lines ----------------------------------------------------------------------------------------------------------

#: Points of a periodogram for each bin of an unpadded one.
PADDING = 2
#: The floor beneath an ordinate is the running median of so many bins. It is as sure as the mean of so many for each
#: (variance of the median of exponential variables, 1/n, over ln(2)^2).
FLOOR_BINS = 101
MEDIAN_EFFICIENCY = 0.48
#: Highest order of the model that whitens, samples for each of its coefficients, and rounds; ordinates higher than so
#: many times the floor are cut before (noise exceeds that in 1 of 150).
WHITENING_ORDER = 4
SAMPLES_PER_ORDER = 128
WHITENING_ROUNDS = 2
CUT = 5.0
#: Nothing is divided by less.
SMALLEST_FLOOR = 1e-300
SMALLEST_GAIN = 1e-12
LEAST_NOISE = 1e-6
#: A tapered spectrum so high above its floor shows a line, whatever the colour of the noise. Measured.
LINE_HEIGHT = 2e4
#: Independent ordinates of a padded periodogram, for each sample: measured on white noise.
INDEPENDENT = 0.8
#: Noise alone shows a line, or a change, in this share of the windows.
LEVEL = 5e-4
#: Tail of the test of changes under noise, chance = 3.6 c exp(-c/2): measured on windows of 64 to 1000 samples.
CHANGE_TAIL = 3.6
#: Lines that join together with the strongest one: how many, bins between them, and the share of its energy that they
#: exceed. They save time only.
FURTHER = 4
LOBES = 8
SIDE_LOBE = 0.1
#: A change of a tone of energy E explains lines of less than E within this number of bins, and of E (bins/d)^2 at d.
CHANGED_BINS = 2.0

# --- fit ------------------------------------------------------------------------------------------------------------

#: Shortest window [samples]; windows of a length overlap by the inverse of the second.
SHORTEST = 64
HOPS = 2
#: Samples for each parameter that is fitted.
SAMPLES_PER_PARAMETER = 3
#: A line closer than so many bins to a tone is a change of it, or a tone that the window does not tell apart.
APART = 1.5
#: Tones of shorter windows are the start in longer ones if their amplitude is so many standard errors.
SURE = 6.0
#: Most steps of a stage of a fit. A record of few tones that hold throughout is fitted at once, in few rounds of few
#: steps: that takes a tenth of the time of windows of all lengths. Lines of what is left are looked for in windows that
#: are shorter by the last factor each.
MOST_STEPS = 60
STEADY_LINES = 8
STEADY_ROUNDS = 2
STEADY_STEPS = 8
STEADY_STEP = 4
#: Samples of the windows that are computed together: what stays in the cache. No result depends on it.
BLOCK_SAMPLES = 2**17

# --- what is left ---------------------------------------------------------------------------------------------------

#: A line of energy E, in units of the noise, d bins from a tone moves its frequency by at most this times sqrt(E)/d
#: standard errors: slope of the phase that it makes, 3 b/(pi d a), over sqrt(6/N) sigma/a, E = N (b/sigma)^2/4.
LEAKAGE = 0.78
#: Greatest ratio of the error of a reading to that of its fit; readings beyond it are not used.
MOST_RAISED = 20.0
#: A window that takes no more lines and leaves one of more than this share of a tone's energy says nothing of it.
COMPARABLE = 0.1
#: Lines of one window closer than so many bins may be one tone that changes. Measured.
RESOLVED = 1.7
#: A window shows so many periods of a tone, and its amplitude is so many standard errors.
PERIODS = 8.0
SIGNIFICANT = 6.0
#: A curvature of the frequency of more than so many of its standard errors adds to the error of the reading; one of
#: more than so many is taken from the reading too.
QUIET = 2.0
BENT = 4.0
#: Frequencies that move by more than so many errors over their window may move otherwise than along a line: a kink
#: that no test finds moves the frequency by this share of the sweep, and by no more than so many errors. Measured.
MOVES = 2.5
KINK = 0.27
HIDDEN_KINK = 18.0
#: A change of energy E moves the frequency by at most these multiples of sqrt(E) standard errors: the largest ratios
#: for a step of phase anywhere in the window, and for one of frequency in its middle, computed without noise. A change
#: that noise shows no more often than this may be there, and is a step of phase at most. What is larger than the last
#: share of the tone's energy may be of any kind.
STEP = 2.8
KINKED = 18.1
DOUBTFUL = 0.1
SMALL_CHANGE = 0.005
#: Two tones in one line, which no test tells from one that grows by so many errors but less than this over half a
#: window, pull its frequency by no more than its growth [rad/sample].
GROWS = 2.0
BLENDED_GROWTH = 1.0
#: What should be covered by so many errors is divided by it.
COVERED = 3.0
#: Three or more lines at distances equal within this share, or so many errors, may be one tone that is modulated: lines
#: of the comb are at most so many distances apart, and what is so many distances from its ends belongs to it.
#: Distances above the last share of the frequency are those of harmonics.
COMB = 3
UNEQUAL = 0.05
EQUAL_ERRORS = 5.0
MOST_APART = 4
BESIDE = 3.0
HARMONIC = 0.2
#: A line of a comb that shorter windows refute at more than this share of the rows is none at the others either.
REFUTED = 0.25

# --- tones over time ------------------------------------------------------------------------------------------------

#: Readings closer than so many bins of the shorter window, or so many standard errors, are of one tone.
SAME_BINS = 1.5
SAME_ERRORS = 5.0
#: A reading goes on with a tone if it is no more than so many standard errors, or bins of the shorter window, off.
GATE_ERRORS = 5.0
GATE_BINS = 1.0
#: A tone without readings for so many rows, or for one of its windows, has ended.
PATIENCE = 3
#: A tone that ends and one that begins after it are the same if their frequencies differ by less than this share, with
#: this share added for a pause as long as the record.
LARGEST_JUMP = 0.25
PAUSE = 0.25
#: What is never known better than to this share of its frequency is no tone.
COARSE = 0.01

# --- what a track leaves of its record ------------------------------------------------------------------------------

#: A spectrum is a median over about so many half-overlapping segments, at most so many, of some lengths, with so many
#: points for each bin; segments in which a larger share is unknown are left out.
SEGMENTS = 16
MOST_SEGMENTS = 32
SHORTEST_SPECTRUM = 64
LONGEST_SPECTRUM = 2**15
SPECTRUM_PADDING = 4
UNKNOWN = 0.1
#: The logarithm of an amplitude changes by no more than this on the way from its row.
MOST_GROWN = 1.0
