/* Numbers of several pixels side by side: vectors of GCC and Clang on a processor, single numbers on a GPU, where each
   thread has a pixel. The rules of level.h are written in these, once for both. */
#pragma once
#include <stdint.h>

#ifdef __CUDACC__
#define RULE static __host__ __device__ __forceinline__
#define LANES 1
typedef int32_t Eight, Four;
typedef uint32_t EightUnsigned;
typedef float EightFloat;
typedef uint64_t Words, Square;
#define LESS(a, b) (-(int32_t)((a) < (b)))
#define SAME(a, b) (-(int32_t)((a) == (b)))
#else
#define RULE static inline __attribute__((always_inline))
#define LANES 8
typedef int32_t Eight __attribute__((vector_size(32)));
typedef uint32_t EightUnsigned __attribute__((vector_size(32)));
typedef int16_t Sixteen __attribute__((vector_size(32)));
typedef float EightFloat __attribute__((vector_size(32)));
typedef int32_t Four __attribute__((vector_size(16)));
typedef uint64_t Square __attribute__((vector_size(32)));
typedef struct { Square low, high; } Words; /* eight feature vectors */
#define LESS(a, b) ((a) < (b))
#define SAME(a, b) ((a) == (b))
#if defined(__SSE2__)
#include <immintrin.h>
#endif
#endif

#define PICK(mask, a, b) (((a) & (mask)) | ((b) & ~(mask))) /* a where the mask is -1, b where it is 0 */

/* Sum of the absolute differences of the eight bytes of two words: the distance of two feature vectors. */
RULE int32_t distance(uint64_t p, uint64_t q) {
#if defined(__CUDA_ARCH__)
  return __vsadu4((uint32_t)p, (uint32_t)q) + __vsadu4((uint32_t)(p >> 32), (uint32_t)(q >> 32));
#elif defined(__SSE2__) && !defined(__CUDACC__)
  return _mm_cvtsi128_si32(_mm_sad_epu8(_mm_cvtsi64_si128((int64_t)p), _mm_cvtsi64_si128((int64_t)q)));
#else
  int32_t total = 0;
  for (int k = 0; k < 64; k += 8) {
    int32_t step = (int32_t)(p >> k & 255) - (int32_t)(q >> k & 255);
    total += step < 0 ? -step : step;
  }
  return total;
#endif
}

#ifdef __CUDACC__

RULE int32_t any(Eight mask) { return mask != 0; }
RULE Eight columns(Eight shift) { return (int16_t)shift; }
RULE Eight moved(Eight shift, int u, int v) { return (Eight)(((uint32_t)(shift >> 16) + v) << 16 | ((uint32_t)shift + u & 0xFFFF)); }
RULE Eight apart(Eight a, Eight b) {
  int u = columns(a) - columns(b), v = (a >> 16) - (b >> 16);
  return (u < 0 ? -u : u) + (v < 0 ? -v : v);
}
RULE Eight below(Eight a, int limit) { return LESS((uint32_t)a, (uint32_t)limit); }
RULE Eight distances(Words a, Words b) { return distance(a, b); }
RULE Four square_distances(Square a, Square b) { return distance(a, b); }
RULE Square square(const uint64_t *words, int64_t at, int cols) { return words[at]; }
RULE Words words_at(const uint64_t *words, Eight index) { return words[index]; }
RULE Eight ints_at(const int32_t *numbers, Eight index) { return numbers[index]; }
RULE Eight magnitude(EightFloat a, float most) { a = fabsf(a); return (int32_t)(a < most ? a : most); }
RULE EightFloat floats(Eight a) { return (float)a; }
RULE EightFloat length(EightFloat a, EightFloat b, float least) { a = sqrtf(a * a + b * b); return a > least ? a : least; }

#else

RULE Square square_sad(Square a, Square b) { /* distances of four words, a number of 64 bits each */
#if defined(__AVX2__)
  return (Square)_mm256_sad_epu8((__m256i)a, (__m256i)b);
#else
  typedef uint8_t Bytes __attribute__((vector_size(32)));
  Bytes p = (Bytes)a, q = (Bytes)b, less = (Bytes)(p < q);
  Square d = (Square)PICK(less, q - p, p - q);
  /* Neighbouring bytes to sums of 16 bits; the product has the sum of the four of a word in its upper 16 bits. */
  d = (d & 0x00FF00FF00FF00FF) + (d >> 8 & 0x00FF00FF00FF00FF);
  return d * 0x0001000100010001 >> 48;
#endif
}
RULE Four square_distances(Square a, Square b) {
  Eight d = (Eight)square_sad(a, b);
  return __builtin_shufflevector(d, d, 0, 2, 4, 6);
}
RULE Eight distances(Words a, Words b) {
  Eight low = (Eight)square_sad(a.low, b.low), high = (Eight)square_sad(a.high, b.high);
  return __builtin_shufflevector(low, high, 0, 2, 4, 6, 8, 10, 12, 14);
}
/* Words of two by two pixels, the first at index `at` of an image of `cols` columns. */
RULE Square square(const uint64_t *words, int64_t at, int cols) {
  const uint64_t *next = words + at + cols;
  return (Square){words[at], words[at + 1], next[0], next[1]};
}
RULE Words words_at(const uint64_t *w, Eight i) {
  return (Words){{w[i[0]], w[i[1]], w[i[2]], w[i[3]]}, {w[i[4]], w[i[5]], w[i[6]], w[i[7]]}};
}
RULE Words eight_words(const uint64_t *w) { /* in halves: as one, GCC would send them through memory */
  Words words;
  __builtin_memcpy(&words.low, w, sizeof words.low);
  __builtin_memcpy(&words.high, w + LANES / 2, sizeof words.high);
  return words;
}
RULE Words seven_words(const uint64_t *w) { /* the fourth one twice: what follows the seven is not read */
  Words words;
  __builtin_memcpy(&words.low, w, sizeof words.low);
  __builtin_memcpy(&words.high, w + 3, sizeof words.high);
  return words;
}
RULE Sixteen four_wide(const int16_t *numbers) { /* four numbers, 64 bits each */
  typedef int16_t FourNumbers __attribute__((vector_size(8)));
  FourNumbers four;
  __builtin_memcpy(&four, numbers, sizeof four);
  return (Sixteen)__builtin_convertvector(four, Square);
}
RULE Sixteen least_of_sixteen(Sixteen a, Sixteen b) {
#if defined(__AVX2__)
  return (Sixteen)_mm256_min_epi16((__m256i)a, (__m256i)b);
#else
  return (Sixteen)PICK(a < b, a, b);
#endif
}
RULE Eight ints_at(const int32_t *n, Eight i) {
  return (Eight){n[i[0]], n[i[1]], n[i[2]], n[i[3]], n[i[4]], n[i[5]], n[i[6]], n[i[7]]};
}
RULE Eight every_other(const int32_t *numbers) { /* eight of fifteen; one more is read */
  Eight low, high;
  __builtin_memcpy(&low, numbers, sizeof low);
  __builtin_memcpy(&high, numbers + LANES, sizeof high);
  return __builtin_shufflevector(low, high, 0, 2, 4, 6, 8, 10, 12, 14);
}
RULE Eight first_ints(const int32_t *numbers, int count) { /* of eight, zeros beyond `count` */
  Eight ints = {0};
  if (count >= LANES) __builtin_memcpy(&ints, numbers, sizeof ints);
  else __builtin_memcpy(&ints, numbers, count * sizeof *numbers);
  return ints;
}
RULE uint32_t bits_of(Eight mask) { /* a bit for each lane, the first one lowest */
#if defined(__AVX2__)
  return (uint32_t)_mm256_movemask_ps((__m256)mask);
#else
  uint32_t bits = 0;
  for (int k = 0; k < LANES; k++) bits |= (uint32_t)(mask[k] & 1) << k;
  return bits;
#endif
}
RULE int32_t any(Eight mask) { return bits_of(mask) != 0; }
RULE Eight columns(Eight shift) { return shift << 16 >> 16; }
RULE Eight moved(Eight shift, int u, int v) { /* in halves: no carry runs from the columns into the rows */
  Eight step = (Eight){} + (int32_t)((uint32_t)v << 16 | (u & 0xFFFF));
  return (Eight)((Sixteen)shift + (Sixteen)step);
}
RULE Sixteen size_of(Sixteen a) {
#if defined(__AVX2__)
  return (Sixteen)_mm256_abs_epi16((__m256i)a);
#else
  return PICK(a < 0, -a, a);
#endif
}
RULE Eight apart(Eight a, Eight b) { /* |u| + |v| of the difference of two displacements */
  Eight size = (Eight)size_of((Sixteen)a - (Sixteen)b);
  return (size & 0xFFFF) + (Eight)((EightUnsigned)size >> 16);
}
RULE Eight below(Eight a, int limit) { return (Eight)((EightUnsigned)a < (uint32_t)limit); }
RULE EightFloat floats(Eight a) { return __builtin_convertvector(a, EightFloat); }
RULE Eight magnitude(EightFloat a, float most) { /* |a| without its fraction, at most `most`, which NaN becomes, too */
  EightFloat size = (EightFloat)((Eight)a & 0x7FFFFFFF), top = (EightFloat){} + most;
  return __builtin_convertvector((EightFloat)PICK(size < top, (Eight)size, (Eight)top), Eight);
}
RULE EightFloat length(EightFloat a, EightFloat b, float least) {
  EightFloat sum = a * a + b * b, floor = (EightFloat){} + least;
#if defined(__AVX2__)
  sum = (EightFloat)_mm256_sqrt_ps((__m256)sum);
#else
  for (int k = 0; k < LANES; k++) sum[k] = __builtin_sqrtf(sum[k]);
#endif
  return (EightFloat)PICK(sum > floor, (Eight)sum, (Eight)floor);
}

#endif
RULE Eight least_of(Eight a, Eight b) {
#if defined(__AVX2__) && !defined(__CUDACC__)
  return (Eight)_mm256_min_epi32((__m256i)a, (__m256i)b);
#else
  return PICK(LESS(a, b), a, b);
#endif
}
