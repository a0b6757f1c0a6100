"""Notes under the tables and captions of the figures."""

INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval, from a sandwich with "
    "the windows of all points as clusters: how far other windows of the same records would move a "
    "number, not how far a law of this form is from the truth; for that see the points left out."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, tied in one refinement, and run freely "
    "from one sample of its record, where the states move least. Errors are those against the "
    "record's cycle; a model lives within 1 % of frequency, 10 % of amplitude and 0.2 standard "
    "deviations of waveform; enclosed: whether the others enclose it."
)
ALSO = " also: other cycles whose law oscillates there, inside its points."
TRIED = (
    "error: mean over the points left out of the largest deviation from the cycle, in units of its "
    "bound (1 % of frequency, 10 % of amplitude, 0.2 of waveform), 10 at most; f error: median; "
    "numbers: of the law; laws through separate refinements. Chosen: the fewest numbers within a "
    "standard error of the least."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters: refined at each point alone (open, with "
    "95 % intervals) and by the law that all points share (lines), at up to five values of the "
    "other parameters. Where the open points leave the lines by more than their bars, other "
    "coefficients make up for it: points are sloppy in some directions, and the law is fitted to "
    "the records, not to them.",
    "left_out": "Points left out, each read off the law of the others. Left: frequency of the free "
    "run over the record's, the band 1 %. Right: errors of amplitude and waveform of each "
    "state, those beyond the panel filled on its edge; band and line are the bounds of a "
    "model that lives.",
    "map": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameters, and of the records in the same colours (circles); crosses: "
    "points that do not oscillate; diamonds: records of another cycle, not fitted here. Black "
    "line: where the model's cycle ends; dashed: where its fixed point turns stable; grey: what "
    "the points that the law was fitted to enclose, beyond which it is extrapolated. White: no "
    "cycle.",
    "line": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameter (line, ending where the cycle does), and of the records "
    "(circles); crosses: points that do not oscillate; diamonds: records of another cycle, not "
    "fitted here. Shaded: between the points that the law was fitted to.",
}
