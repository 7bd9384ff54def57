"""Every constant of the tracker that decides something, with its source or the measurement that set it.

"Measured" marks values that were set on signals of ``benchmarks/track_honesty.py``, with an earlier form of this
tracker. What has neither that mark nor a source is a choice; the benchmark tests all of them together. Constants of the
compiled fit are in :mod:`ctid_cli.tones.tone_kernels`.
"""

# --- request --------------------------------------------------------------------------------------------------------

#: Name of the method in files.
METHOD = "tone_windows"
#: A row is accurate if its standard error is at most this share of the frequency, unless another limit is given.
USUAL_ACCURACY = 0.001
#: Largest number of tones that can be requested, and of lines in one window: 321 equations. A low guitar string has 45
#: lines at once. Measured.
MOST_TONES = 64
MOST_LINES = 64
#: Default number of rows of a track: the resolution of a figure.
USUAL_ROWS = 1000
#: Largest number of reported missing lines.
MOST_MISSING = 5
#: Share of the Nyquist frequency above which a tone may be an alias.
SUSPICIOUS = 0.9

# --- record ---------------------------------------------------------------------------------------------------------

#: Fewest samples of a record: half of the shortest window.
FEWEST = 32
#: A signal with a smaller relative variation is constant; double precision rounds to 2e-16.
CONSTANT = 1e-12
#: Fourth powers of smaller or larger samples would underflow or overflow.
SMALLEST_SAMPLE = 1e-60
LARGEST_SAMPLE = 1e60
#: Dither as a share of the largest sample: far above rounding, far below 16 bits.
DITHER = 1e-7
#: A spike exceeds SPIKE_TIMES the largest of SPIKE_AROUND samples on each side, except the SPIKE_WIDTH nearest ones.
#: Records with a larger share of such samples are pulse trains.
SPIKE_TIMES = 6.0
SPIKE_AROUND = 64
SPIKE_WIDTH = 2
MOST_SPIKES = 0.01
#: Fewest samples after decimation: with them the fit of 60 s takes a second.
FEWEST_KEPT = 2**15
#: Decimation: share of the band that is kept, share of the band that contains the highest line, and attenuation of
#: aliases [dB], which are then below the local noise level of 60 dB records.
KEPT_BAND = 0.9
TONE_BAND = 0.8
STOP_BAND = 60.0
#: Zero-padding factor of the low-pass frequency response; its linear interpolation has an error of 1.3e-5.
RESPONSE_PADDING = 32
#: Gaps shorter than this share of the shortest period are interpolated linearly before a filter: the error is 1 %.
BRIDGED = 0.05
#: Shortest segment in the search for the highest line, and share of noise records with a false line.
SHORTEST_SEGMENT = 1024
FALSE_LINES = 1e-3

# --- lines ----------------------------------------------------------------------------------------------------------

#: Zero-padding factor of periodograms.
PADDING = 2
#: The noise floor is the running median of FLOOR_BINS bins. The efficiency is relative to the mean of exponential
#: variables: the median has the variance 1/n, over ln(2)^2.
FLOOR_BINS = 101
MEDIAN_EFFICIENCY = 0.48
#: Whitening model: highest order, samples per coefficient, rounds, and ratio to the noise floor at which ordinates are
#: clipped before (noise exceeds it in 1 of 150).
WHITENING_ORDER = 4
SAMPLES_PER_ORDER = 128
WHITENING_ROUNDS = 2
CUT = 5.0
#: Smallest divisors.
SMALLEST_FLOOR = 1e-300
SMALLEST_GAIN = 1e-12
LEAST_NOISE = 1e-6
#: Ratio of a tapered spectrum to its noise floor that shows a line in noise of any colour. Measured.
LINE_HEIGHT = 2e4
#: Independent ordinates of a padded periodogram per sample, measured on white noise.
INDEPENDENT = 0.8
#: Significance level per window of the tests for lines and changes.
LEVEL = 5e-4
#: Factor of the p-value of the test for changes, 3.6 c exp(-c/2), measured on windows of 64 to 1000 samples.
CHANGE_TAIL = 3.6
#: Lines added together with the strongest one, to save time only: their number, bins between them, and the share of
#: its energy that they exceed.
FURTHER = 4
LOBES = 8
SIDE_LOBE = 0.1
#: A change with energy E explains lines of less than E within this number of bins, and of E (bins/d)^2 at d.
CHANGED_BINS = 2.0

# --- fit ------------------------------------------------------------------------------------------------------------

#: Shortest window [samples], and number of windows of a length that start within one window.
SHORTEST = 64
HOPS = 2
#: Samples per fitted parameter.
SAMPLES_PER_PARAMETER = 3
#: A line closer to a tone than this number of bins is a change of it, or a tone that the window does not resolve.
APART = 1.5
#: Least amplitude, in standard errors, of a tone in shorter windows that starts the fit of a longer one.
SURE = 6.0
#: Largest number of steps of a stage of a fit. A record of few steady tones is fitted as a whole, in few rounds of few
#: steps: this takes a tenth of the time of windows of all lengths. Its residual is tested for lines in windows that are
#: shorter by STEADY_STEP each.
MOST_STEPS = 60
STEADY_LINES = 8
STEADY_ROUNDS = 2
STEADY_STEPS = 8
STEADY_STEP = 4
#: Samples of the windows that are computed together, which fit in the cache. No result depends on it.
BLOCK_SAMPLES = 2**17

# --- residuals ------------------------------------------------------------------------------------------------------

#: A line of energy E, in units of the noise, at d bins from a tone biases its frequency by at most this times sqrt(E)/d
#: standard errors: slope of the phase error, 3 b/(pi d a), over sqrt(6/N) sigma/a, E = N (b/sigma)^2/4.
LEAKAGE = 0.78
#: Largest ratio of the error of a reading to that of its fit; readings beyond it are not used.
MOST_RAISED = 20.0
#: A full window gives no reading of a tone if its residual has a line of more than this share of the tone's energy.
COMPARABLE = 0.1
#: Lines of one window closer than this number of bins may be one tone that changes. Measured.
RESOLVED = 1.7
#: Fewest periods of a tone in a window, and its least amplitude in standard errors.
PERIODS = 8.0
SIGNIFICANT = 6.0
#: Curvatures of the frequency, in standard errors, above which it adds to the error of the reading, and above which the
#: reading is corrected for it.
QUIET = 2.0
BENT = 4.0
#: A frequency with a rate of more than MOVES standard errors may change nonlinearly: an undetected kink shifts it by
#: the share KINK of the sweep, and by at most HIDDEN_KINK standard errors. Measured.
MOVES = 2.5
KINK = 0.27
HIDDEN_KINK = 18.0
#: A change of energy E shifts the frequency by at most these multiples of sqrt(E) standard errors: the largest ratios
#: for a step of phase anywhere in the window, and for one of frequency in its middle, computed without noise. A change
#: with a p-value below DOUBTFUL is possible, and at most a step of phase. One above the share SMALL_CHANGE of the
#: tone's energy may be of any kind.
STEP = 2.8
KINKED = 18.1
DOUBTFUL = 0.1
SMALL_CHANGE = 0.005
#: Two unresolved tones may look like one whose growth exceeds GROWS errors but not BLENDED_GROWTH over half a window;
#: they bias its frequency by at most its growth [rad/sample].
GROWS = 2.0
BLENDED_GROWTH = 1.0
#: Standard errors that must cover a bias: biases are divided by this number.
COVERED = 3.0
#: COMB or more lines with spacings equal within the share UNEQUAL, or EQUAL_ERRORS, may be one modulated tone. Adjacent
#: lines of the comb are at most MOST_APART spacings apart; lines within BESIDE spacings of its ends belong to it.
#: Spacings above the share HARMONIC of the frequency are those of harmonics.
COMB = 3
UNEQUAL = 0.05
EQUAL_ERRORS = 5.0
MOST_APART = 4
BESIDE = 3.0
HARMONIC = 0.2
#: A line of a comb that shorter windows reject at more than this share of the rows is rejected at all rows.
REFUTED = 0.25

# --- tones over time ------------------------------------------------------------------------------------------------

#: Bins of the shorter window, and standard errors, within which readings are of one tone.
SAME_BINS = 1.5
SAME_ERRORS = 5.0
#: Largest deviation of a reading that continues a tone [standard errors, or bins of the shorter window].
GATE_ERRORS = 5.0
GATE_BINS = 1.0
#: A tone ends after more rows without readings than this, and than one of its windows.
PATIENCE = 3
#: A tone that ends and one that begins later are one tone if their relative frequency difference is below LARGEST_JUMP;
#: a pause as long as the record adds PAUSE.
LARGEST_JUMP = 0.25
PAUSE = 0.25
#: Relative standard error of the frequency that a tone must reach at some row.
COARSE = 0.01

# --- residual of a track --------------------------------------------------------------------------------------------

#: A spectrum is a median over about SEGMENTS half-overlapping segments: their largest number, shortest and longest
#: length, zero-padding factor, and largest share of unknown samples in a segment.
SEGMENTS = 16
MOST_SEGMENTS = 32
SHORTEST_SPECTRUM = 64
LONGEST_SPECTRUM = 2**15
SPECTRUM_PADDING = 4
UNKNOWN = 0.1
#: Largest change of the logarithm of an amplitude extrapolated from its row.
MOST_GROWN = 1.0
