/* Loops over the pixels of a level; one thread, in order. Compiled once for each instruction set, which VARIANT names. */
#include <math.h>
#include <string.h>
#include "level.h"

#define JOIN(name, variant) name##variant
#define NAMED(name, variant) JOIN(name, variant)
#define EXPORT(name) NAMED(name, VARIANT)

/* Number of the best instruction set of this processor; compiled for any processor only. */
#ifdef ANY_PROCESSOR
int supported(void) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")) return 2;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) return 1;
#endif
  return 0;
}
#endif

/* ---- search ---- */

/* Displacements and costs of an image from those of the coarser level, half as large. `centres`: room for as many. */
void EXPORT(search)(const Pair *pair, const int16_t *up_u, const int16_t *up_v, const Shift *reach, int32_t *shift,
                    int32_t *cost, int32_t *centres) {
  int32_t rows = pair->left.rows, cols = pair->left.cols, up_rows = (rows + 1) / 2;
  Parents up = {up_u, up_v, (cols + 1) / 2};
  for (int32_t j = 0; j < up_rows; j++) {
    RowLines row = row_lines(&pair->band, 2 * j + 0.5);
    for (int32_t i = 0; i < up.cols; i++) centres[(int64_t)j * up.cols + i] = centre_of(pair, &up, row, i, j);
  }
  for (int32_t j = 0; j < up_rows; j++) {
    RowLines row = row_lines(&pair->band, 2 * j + 0.5);
    const int32_t *own = centres + (int64_t)j * up.cols;
    const int32_t *above = j > 0 ? own - up.cols : own, *below_ = j + 1 < up_rows ? own + up.cols : own;
    for (int32_t i = 0; i < up.cols; i++) {
      const int32_t near[CENTRES] = {own[i], own[within(i - 1, up.cols)], own[within(i + 1, up.cols)], above[i], below_[i]};
      Children best = search_parent(pair, row, near, (Shift){i, j}, *reach);
      for (int n = 0; n < 4; n++) {
        int32_t x = 2 * i + (n & 1), y = 2 * j + (n >> 1);
        if (x < cols && y < rows) shift[(int64_t)y * cols + x] = best.shift[n], cost[(int64_t)y * cols + x] = best.cost[n];
      }
    }
  }
}

/* ---- propagation ---- */

typedef struct { int32_t *shift, *cost; } Field;          /* displacements, and what they cost */
typedef struct { int32_t *columns, *shift, *cost; } Todo; /* columns of a row to look at, and what was settled there */

/* One colour of row y. `dirty`: pixels to look at. */
static void turn_row(const Pair *pair, Field field, uint8_t *dirty, Todo todo, int32_t y, int32_t turn, Smoothing how) {
  int32_t rows = pair->left.rows, cols = pair->left.cols, n = 0;
  int32_t above = y > 0 ? y - 1 : rows > 1, below_ = y + 1 < rows ? y + 1 : rows > 1 ? rows - 2 : 0;
  int64_t start = (int64_t)y * cols;
  uint8_t *flags = dirty + start, *before = dirty + (int64_t)above * cols, *after = dirty + (int64_t)below_ * cols;
  /* The first turn of each colour looks at every pixel; later ones at what was marked. */
  for (int32_t x = (y + turn) & 1; x < cols; x += 2) {
    todo.columns[n] = x;
    n += turn < 2 || flags[x];
    flags[x] = 0;
  }
  if (n == 0) return;
  /* Vectors run past the end of the list; settling the last pixel again does no harm. */
  for (int k = 0; k < LANES; k++) todo.columns[n + k] = todo.columns[n - 1];
  RowLines row = row_lines(&pair->band, y);
  const int32_t *own = field.shift + start, *up = field.shift + (int64_t)above * cols;
  const int32_t *down = field.shift + (int64_t)below_ * cols, *cost = field.cost + start;
  for (int32_t k = 0; k < n; k += LANES) {
    Eight x, first, last, mine, stay, near[4];
    memcpy(&x, todo.columns + k, sizeof x);
    int32_t a = x[0], b = x[LANES - 1];
    /* Without a gap between the eight columns plain loads stand for gathered ones. */
    if (k + LANES <= n && b - a == 2 * LANES - 2 && a > 0 && b + 2 < cols) {
      mine = every_other(own + a), stay = every_other(cost + a);
      near[0] = every_other(up + a), near[1] = every_other(own + a - 1);
      near[2] = every_other(own + a + 1), near[3] = every_other(down + a);
    } else {
      /* Beyond the border the pixel on the other side stands in. */
      first = x == 0, last = x == cols - 1;
      Eight west = PICK(first, (Eight){} + (cols > 1), x - 1);
      Eight east = PICK(last, (Eight){} + (cols > 1 ? cols - 2 : 0), x + 1);
      mine = ints_at(own, x), stay = ints_at(cost, x);
      near[0] = ints_at(up, x), near[1] = ints_at(own, west), near[2] = ints_at(own, east), near[3] = ints_at(down, x);
    }
    Words words = words_at(pair->left.words + start, x);
    Look look = {pair, words, x, y, lines_at(row, floats(x)), near, how.smoothness};
    Settled best = settle(&look, mine, stay, how.beside);
    memcpy(todo.shift + k, &best.shift, sizeof best.shift);
    memcpy(todo.cost + k, &best.cost, sizeof best.cost);
  }
  for (int32_t k = 0; k < n; k++) {
    int32_t x = todo.columns[k];
    int32_t changed = how.rounds > 1 && todo.shift[k] != own[x];
    field.shift[start + x] = todo.shift[k], field.cost[start + x] = todo.cost[k];
    /* The pixel itself as well: what lies beside its new displacement has not been tried. */
    if (changed) before[x] = after[x] = flags[x] = flags[x > 0 ? x - 1 : 0] = flags[x + 1 < cols ? x + 1 : x] = 1;
  }
}

/* Rounds over the two colours of a checkerboard, in place. Each turn follows the one before at a row's distance, so that
   all of them pass over the image while it is at hand. `dirty`: zeros, a byte a pixel; `room`: 3 (cols + LANES). */
void EXPORT(propagate)(const Pair *pair, int32_t *shift, int32_t *cost, const Smoothing *smoothing, uint8_t *dirty,
                       int32_t *room) {
  int32_t rows = pair->left.rows, wide = pair->left.cols + LANES, turns = 2 * smoothing->rounds;
  Todo todo = {room, room + wide, room + 2 * wide};
  Smoothing how = *smoothing;
  if (pair->band.cost < SHARP) how.beside = 2;
  for (int32_t step = 0; turns && step < rows + turns - 1; step++) {
    for (int32_t turn = step - rows + 1 > 0 ? step - rows + 1 : 0; turn < turns && turn <= step; turn++)
      turn_row(pair, (Field){shift, cost}, dirty, todo, step - turn, turn, how);
  }
}

/* ---- fractions of a pixel ---- */

enum { SUM_RADIUS = 2, WINDOW = 2 * SUM_RADIUS + 1, SIDE_BY_SIDE = LANES - WINDOW + 1 };
typedef struct { int32_t at, west, east, north, south; } Sums; /* distances at a displacement, and a pixel beside it */

/* Where two lines of equal and opposite slope through three distances meet, within half a pixel. */
static inline float fraction(int32_t before, int32_t at, int32_t after) {
  int32_t steep = (before > after ? before : after) - at;
  float d = (float)(before - after) / (float)(steep > 1 ? steep : 1) * 0.5f;
  d = d > -0.5f ? d : -0.5f;
  d = d < 0.5f ? d : 0.5f;
  return steep > 0 ? d : 0.0f;
}
/* Sum over the window of a pixel, from words `here` of the left and `there` of the right image. */
static int32_t window_sum(const uint64_t *here, const uint64_t *there, int32_t cols, int32_t right_cols) {
  int32_t sum = 0;
  for (int j = -SUM_RADIUS; j <= SUM_RADIUS; j++)
    for (int i = -SUM_RADIUS; i <= SUM_RADIUS; i++) sum += distance(here[j * cols + i], there[j * right_cols + i]);
  return sum;
}
static inline void add_distances(Words *total, Words own, const uint64_t *there) {
  Words other = eight_words(there);
  total->low += square_sad(own.low, other.low), total->high += square_sad(own.high, other.high);
}
/* Sums over the windows of pixels side by side, of eight words from two columns before `here` and `there` on. */
static inline void sum_windows(const uint64_t *here, const uint64_t *there, int32_t cols, int32_t right_cols,
                               Sums out[SIDE_BY_SIDE]) {
  Words at = {0}, west = {0}, east = {0}, north = {0}, south = {0};
  for (int j = -SUM_RADIUS; j <= SUM_RADIUS; j++) {
    const uint64_t *row = there + j * right_cols - SUM_RADIUS;
    Words own = eight_words(here + j * cols - SUM_RADIUS);
    add_distances(&at, own, row);
    add_distances(&west, own, row - 1), add_distances(&east, own, row + 1);
    add_distances(&north, own, row - right_cols), add_distances(&south, own, row + right_cols);
  }
  /* A sum of 25 distances has 16 bits: four are added up in one word. */
  Words packed = {at.low | west.low << 16 | east.low << 32 | north.low << 48,
                  at.high | west.high << 16 | east.high << 32 | north.high << 48};
  uint64_t four[LANES], last[LANES];
  memcpy(four, &packed, sizeof four), memcpy(last, &south, sizeof last);
  for (int n = 0; n < SIDE_BY_SIDE; n++) {
    uint64_t sum = 0, fifth = 0;
    for (int i = 0; i < WINDOW; i++) sum += four[n + i], fifth += last[n + i];
    out[n] = (Sums){sum & 0xFFFF, sum >> 16 & 0xFFFF, sum >> 32 & 0xFFFF, sum >> 48, (int32_t)fifth};
  }
}
/* Displacements with fractions from distances summed over 5 x 5 pixels, and the mean distance; where the window, moved
   by a pixel, leaves an image, the displacement as it is and the pixel's own distance; -1 outside, or not wanted. */
void EXPORT(sums)(const Pair *pair, const int16_t *us, const int16_t *vs, const uint8_t *wanted, float *out_u, float *out_v,
                  float *out_distance) {
  int32_t rows = pair->left.rows, cols = pair->left.cols, far = SUM_RADIUS + 1;
  int32_t right_rows = pair->right.rows, right_cols = pair->right.cols;
  Sums found[SIDE_BY_SIDE];
  for (int32_t y = 0; y < rows; y++) {
    for (int32_t x = 0, n = 1; x < cols; x += n) {
      int64_t i = (int64_t)y * cols + x;
      int32_t u = us[i], v = vs[i], xr = x + u, yr = y + v;
      n = 1;
      out_u[i] = (float)u, out_v[i] = (float)v, out_distance[i] = -1.0f;
      if (!wanted[i] || xr < 0 || xr >= right_cols || yr < 0 || yr >= right_rows) continue;
      const uint64_t *here = pair->left.words + i, *there = pair->right.words + (int64_t)yr * right_cols + xr;
      int32_t most = cols - SUM_RADIUS - x < right_cols - far - xr ? cols - SUM_RADIUS - x : right_cols - far - xr;
      if (x < SUM_RADIUS || y < SUM_RADIUS || y + SUM_RADIUS >= rows || xr < far || yr < far || yr + far >= right_rows ||
          most <= 0) {
        out_distance[i] = (float)distance(*here, *there);
        continue;
      }
      if (most >= SIDE_BY_SIDE) {
        /* Neighbours of equal displacement are summed together. */
        while (n < SIDE_BY_SIDE && us[i + n] == u && vs[i + n] == v && wanted[i + n]) n++;
        sum_windows(here, there, cols, right_cols, found);
      } else {
        found[0] = (Sums){window_sum(here, there, cols, right_cols),
                          window_sum(here, there - 1, cols, right_cols), window_sum(here, there + 1, cols, right_cols),
                          window_sum(here, there - right_cols, cols, right_cols),
                          window_sum(here, there + right_cols, cols, right_cols)};
      }
      for (int k = 0; k < n; k++) {
        Sums s = found[k];
        out_u[i + k] = (float)u + fraction(s.west, s.at, s.east);
        out_v[i + k] = (float)v + fraction(s.north, s.at, s.south);
        out_distance[i + k] = (float)s.at / (float)(WINDOW * WINDOW);
      }
    }
  }
}

/* ---- depth edges ---- */

/* What these limit, and why they are as they are: see reference.py. */
enum { EDGE_REACH = 4, EDGE_RADIUS = 3, EDGE_SIDE = 2 * EDGE_RADIUS + 1, MIN_APART = 4, EDGE_GREY = 16,
       MAX_EDGE_DISTANCE = 100, OWN_FACTOR = 9, OTHER_FACTOR = 10 };
typedef struct { Sixteen low, high; } Weights; /* of seven pixels side by side, as `seven_words` has them */

static inline Sixteen edge_weight(Sixteen step) {
  Sixteen weight = EDGE_GREY - PICK(step < 0, -step, step);
  return weight & (weight > 0);
}
/* By how much less than EDGE_GREY the pixels of the window from `grey` on differ from its middle. */
static inline void edge_weights(const int16_t *grey, int32_t cols, Weights out[EDGE_SIDE]) {
  int16_t own = grey[EDGE_RADIUS * cols + EDGE_RADIUS];
  for (int j = 0; j < EDGE_SIDE; j++, grey += cols) {
    /* A distance is in the first of the four numbers of a word, and the others are zero, whatever their weight. */
    out[j] = (Weights){edge_weight(four_wide(grey) - own), edge_weight(four_wide(grey + 3) - own)};
    out[j].high[0] = 0;
  }
}
/* Sum of the distances, limited, by their weights: below 7 x 7 x 100 x 16, so that 16 bits hold a column. */
static inline int32_t edge_cost(const uint64_t *here, const uint64_t *there, const Weights *weight, int32_t cols,
                                int32_t right_cols) {
  Sixteen total = {0}, most = total + MAX_EDGE_DISTANCE;
  for (int j = 0; j < EDGE_SIDE; j++, here += cols, there += right_cols) {
    Words a = seven_words(here), b = seven_words(there);
    total += weight[j].low * least_of_sixteen((Sixteen)square_sad(a.low, b.low), most);
    total += weight[j].high * least_of_sixteen((Sixteen)square_sad(a.high, b.high), most);
  }
  int32_t sum = 0;
  for (int k = 0; k < LANES * 2; k += 4) sum += total[k];
  return sum;
}
typedef struct { int32_t x, y; int64_t at; } Place; /* a pixel, and its index */

/* Which displacements differ from others by MIN_APART columns or rows. */
static inline Eight differ(Eight shift, Eight other) {
  return (Eight)(size_of((Sixteen)shift - (Sixteen)other) >= MIN_APART) != 0;
}
/* What the displacement of a pixel costs; negative: it leads out of the right image. */
static inline int32_t cost_there(const Pair *pair, Place p, int32_t shift, const Weights *weight) {
  int32_t cols = pair->left.cols, right_cols = pair->right.cols;
  int32_t y = p.y + (shift >> 16), x = p.x + (int16_t)shift;
  if (y < EDGE_RADIUS || y >= pair->right.rows - EDGE_RADIUS || x < EDGE_RADIUS || x >= right_cols - EDGE_RADIUS) return -1;
  const uint64_t *here = pair->left.words + p.at - (int64_t)EDGE_RADIUS * cols - EDGE_RADIUS;
  const uint64_t *there = pair->right.words + (int64_t)(y - EDGE_RADIUS) * right_cols + x - EDGE_RADIUS;
  return edge_cost(here, there, weight, cols, right_cols);
}
/* The displacement of a pixel, chosen among its own and the different ones of those `around`. */
static int32_t chosen(const Pair *pair, Place p, const int16_t *grey, int32_t own, Eight around, int32_t near_sign) {
  Weights weight[EDGE_SIDE];
  edge_weights(grey + p.at - (int64_t)EDGE_RADIUS * pair->left.cols - EDGE_RADIUS, pair->left.cols, weight);
  int32_t best = own, least = cost_there(pair, p, own, weight) * OWN_FACTOR;
  Eight other = differ(around, (Eight){} + own);
  for (uint32_t left; least >= 0 && (left = bits_of(other));) {
    int32_t tried = around[__builtin_ctz(left)], cost = cost_there(pair, p, tried, weight);
    cost *= near_sign * ((int16_t)tried - (int16_t)own) < 0 ? OWN_FACTOR : OTHER_FACTOR;
    if (cost >= 0 && cost < least) least = cost, best = tried;
    other &= differ(around, (Eight){} + tried);
  }
  return best;
}
/* Displacements of the wanted pixels, chosen anew among those around; pair: words of compact features; near_sign: of the
   columns of nearer things, 0 unknown. */
void EXPORT(edges)(const Pair *pair, const int16_t *grey, const int32_t *shift, const uint8_t *wanted, int32_t near_sign,
                   int32_t *out) {
  int32_t cols = pair->left.cols, reach = EDGE_REACH;
  const int64_t far = reach, half = far / 2;
  const int64_t aside[8] = {half * cols, -half * cols, half, -half, far * cols, -far * cols, far, -far};
  for (int32_t y = reach; y < pair->left.rows - reach; y++) {
    for (int32_t x = reach; x < cols - reach; x += LANES) {
      int64_t i = (int64_t)y * cols + x;
      int32_t count = cols - reach - x;
      Eight own = first_ints(shift + i, count), marks = {0};
      for (int n = 0; n < 8; n++) marks |= differ(first_ints(shift + i + aside[n], count), own);
      /* Most pixels have one displacement around them. */
      for (uint32_t left = bits_of(marks); left; left &= left - 1) {
        int32_t k = __builtin_ctz(left);
        int64_t at = i + k;
        if (!wanted[at]) continue;
        Eight around = {0};
        for (int n = 0; n < 8; n++) around[n] = shift[at + aside[n]];
        out[at] = chosen(pair, (Place){x + k, y, at}, grey, own[k], around, near_sign);
      }
    }
  }
}

/* ---- paths ---- */

/* Candidates, and costs: what they are of, see reference.py. */
enum { MOST = 8, NONE = 32767, OUTSIDE = 8000, UNIT = 4, COMPACT = 8, SMALL = 36, LARGE = 240, LARGE_GREY = 10 };
typedef struct { Eight shift; int32_t count; } List; /* beyond `count` the first displacement is repeated */
typedef struct { Eight shift, cost, total; } Candidates; /* of a pixel; total: with what the paths to it cost */

/* Append a displacement that leads into the right image and is not there yet. */
static inline void append(const Pair *pair, int32_t x, int32_t y, int32_t shift, List *list) {
  const Eight order = {0, 1, 2, 3, 4, 5, 6, 7};
  Eight tried = (Eight){} + shift;
  if (list->count == MOST || !inside(&pair->right, x + (int16_t)shift, y + (shift >> 16)) || any(SAME(list->shift, tried)))
    return;
  list->shift = PICK(SAME(order, (Eight){} + list->count), tried, list->shift);
  list->count++;
}
/* Candidates of a pixel: the own displacement, those a pixel beside it, those of near and farther pixels, and those of the
   coarser level, `up`, doubled and in rows of `up_cols`; 0: there is none. */
static List candidates_of(const Pair *pair, const int32_t *up, int32_t up_cols, const int32_t *maps, int32_t x, int32_t y) {
  static const int8_t around[12][2] = {{0, -1}, {0, 1}, {-1, 0}, {1, 0}, {-3, -3}, {-3, 3}, {3, -3}, {3, 3},
                                       {0, -8}, {0, 8}, {-8, 0}, {8, 0}};
  int32_t rows = pair->left.rows, cols = pair->left.cols, shift = maps[(int64_t)y * cols + x];
  Shift own = unpack(shift);
  List list = {(Eight){} + shift, 1};
  for (int n = 0; n < 4; n++) append(pair, x, y, pack(own.u + around[n][1], own.v + around[n][0]), &list);
  for (int n = 0; n < 12; n++)
    append(pair, x, y, maps[(int64_t)within(y + around[n][0], rows) * cols + within(x + around[n][1], cols)], &list);
  for (int n = 0; up_cols && n < 9; n++) {
    int32_t row = within(y / 2 + n / 3 - 1, (rows + 1) / 2);
    append(pair, x, y, up[(int64_t)row * up_cols + within(x / 2 + n % 3 - 1, up_cols)], &list);
  }
  return list;
}
/* Candidates of a pixel, each once, and their costs; all but the first lead into the right image. `compact`: the images'
   compact features. */
static Candidates listed(const Pair *pair, const Pair *compact, List list, int32_t x, int32_t y) {
  const Eight order = {0, 1, 2, 3, 4, 5, 6, 7};
  int32_t right_cols = pair->right.cols;
  int64_t i = place(&pair->left, x, y);
  RowLines row = row_lines(&pair->band, y);
  Line line = line_at(row, (float)x, (float)(UNIT + COMPACT) * row.cost);
  Eight u = columns(list.shift), v = list.shift >> 16, xr = u + x, yr = v + y;
  Eight within_right = below(xr, right_cols) & below(yr, pair->right.rows), at = (yr * right_cols + xr) & within_right;
  Square own = (Square){} + pair->left.words[i], own_compact = (Square){} + compact->left.words[i];
  Eight cost = UNIT * distances((Words){own, own}, words_at(pair->right.words, at));
  cost += COMPACT * distances((Words){own_compact, own_compact}, words_at(compact->right.words, at));
  cost = PICK(within_right, cost, (Eight){} + OUTSIDE);
  cost += magnitude(line.a * floats(u) + line.b * floats(v) + line.c, 2 * OUTSIDE);
  /* Leaves room below NONE for the greatest step, 10000. */
  cost = PICK(order < list.count, least_of(cost, (Eight){} + 2 * OUTSIDE), (Eight){} + NONE);
  return (Candidates){list.shift, cost, {0}};
}
/* Costs of a pixel's candidates from those of the pixel before on a path:
   cost + min over m (before[m] + min(SMALL |difference to m|, far)) - min over m before[m]. */
static inline Eight path_step(const Candidates *here, const Candidates *from, Eight before, int32_t far) {
  Eight top = (Eight){} + far;
  int32_t least = before[0];
  for (int m = 1; m < MOST; m++) least = before[m] < least ? before[m] : least;
  Eight best = top + least;
  for (int m = 0; m < MOST; m++)
    best = least_of(best, before[m] + least_of(SMALL * apart(here->shift, (Eight){} + from->shift[m]), top));
  return least_of(here->cost + best - least, (Eight){} + NONE);
}
/* Add to all totals the costs along three directions: from the upper left, above, the upper right; `s` = -1: their
   opposites. `room`: six rows. */
static void sweep(const Pair *pair, Candidates *all, const float *grey, int32_t s, Eight *room) {
  int32_t rows = pair->left.rows, cols = pair->left.cols;
  Eight *before = room, *after = room + 3 * cols;
  for (int32_t row = 0; row < rows; row++) {
    int32_t y = s < 0 ? rows - 1 - row : row;
    for (int32_t x = 0; x < cols; x++) {
      int64_t at = place(&pair->left, x, y);
      for (int d = 0; d < 3; d++) {
        int32_t i = x + s * (d - 1);
        Eight cost = all[at].cost;
        if (inside(&pair->left, i, y - s)) {
          int64_t from = place(&pair->left, i, y - s);
          int32_t jump = (int32_t)(LARGE / (1.0f + fabsf(grey[at] - grey[from]) / LARGE_GREY));
          /* Small differences cost less than jumps even where the grey step is greatest. */
          cost = path_step(&all[at], &all[from], before[d * cols + i], jump > 2 * SMALL ? jump : 2 * SMALL);
        }
        after[d * cols + x] = cost;
        all[at].total += cost;
      }
    }
    Eight *other = before;
    before = after, after = other;
  }
}
/* Displacements of least cost along paths; of equal ones the first candidate's. `room`: a Candidates a pixel, and six rows
   of Eight, at a multiple of 32 bytes. */
void EXPORT(paths)(const Pair *pair, const Pair *compact, const int32_t *up, int32_t up_cols, const float *grey,
                   int32_t *maps, void *room) {
  int32_t rows = pair->left.rows, cols = pair->left.cols;
  int64_t pixels = (int64_t)rows * cols;
  Candidates *all = room;
  for (int32_t y = 0; y < rows; y++)
    for (int32_t x = 0; x < cols; x++)
      all[place(&pair->left, x, y)] = listed(pair, compact, candidates_of(pair, up, up_cols, maps, x, y), x, y);
  sweep(pair, all, grey, 1, (Eight *)(all + pixels));
  sweep(pair, all, grey, -1, (Eight *)(all + pixels));
  for (int64_t i = 0; i < pixels; i++) {
    int best = 0;
    for (int k = 1; k < MOST; k++) best = all[i].cost[k] != NONE && all[i].total[k] < all[i].total[best] ? k : best;
    maps[i] = all[i].shift[best];
  }
}
