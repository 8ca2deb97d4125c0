// The DW1000's registers according to its user manual (2.12, chapter 7): address, reset value and access of
// each. The table is written from the manual and not shared with the driver, so that neither hides the
// other's mistakes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

namespace groma::sim {

enum class Reg : std::uint8_t {
  kDevId,
  kEui,
  kPanAdr,
  kSysCfg,
  kSysTime,
  kTxFctrl,
  kTxBuffer,
  kDxTime,
  kRxFwto,
  kSysCtrl,
  kSysMask,
  kSysStatus,
  kRxFinfo,
  kRxBuffer,
  kRxFqual,
  kRxTtcki,
  kRxTtcko,
  kRxTime,
  kTxTime,
  kTxAntd,
  kAckRespT,
  kTxPower,
  kChanCtrl,
  kUsrSfd,
  kAgcCtrl1,
  kAgcTune1,
  kAgcTune2,
  kAgcTune3,
  kEcCtrl,
  kDrxTune0b,
  kDrxTune1a,
  kDrxTune1b,
  kDrxTune2,
  kDrxSfdtoc,
  kDrxPretoc,
  kDrxTune4h,
  kDrxCarInt,
  kRxpaccNosat,
  kRfConf,
  kRfRxCtrlH,
  kRfTxCtrl,
  kRfSensorBias,
  kRfSensorEnable,
  kRfStatus,
  kTcSarc,
  kTcSarlSupply,
  kTcSarlTemperature,
  kTcPgDelay,
  kFsPllCfg,
  kFsPllTune,
  kFsXtalt,
  kAonWcfg,
  kAonCtrl,
  kAonCfg0,
  kAonCfg1,
  kOtpAddr,
  kOtpCtrl,
  kOtpStat,
  kOtpRdat,
  kOtpSf,
  kLdeThresh,
  kLdeCfg1,
  kLdePpIndx,
  kLdePpAmpl,
  kLdeRxAntd,
  kLdeCfg2,
  kLdeRepc,
  kEvcCtrl,
  kEvcPhe,
  kEvcRse,
  kEvcFcg,
  kEvcFce,
  kEvcFfr,
  kEvcOvr,
  kEvcSto,
  kEvcPto,
  kEvcFwto,
  kEvcTxfs,
  kEvcHpw,
  kEvcTpw,
  kPmscCtrl0,
  kPmscCtrl1,
  kCount,
};

enum class Access : std::uint8_t {
  kReadOnly,
  kReadWrite,
  kWriteOneToClear,
  kCommand,  // a write executes commands; reads give 0
};

struct RegisterInfo {
  Reg reg;
  const char* name;
  std::uint8_t file;
  std::uint16_t offset;
  std::uint16_t length;
  Access access;
  std::uint64_t reset;  // of the first 8 bytes; the rest is 0
};

// The register that contains the byte at this offset of this register file; null without one.
[[nodiscard]] const RegisterInfo* find_register(std::uint8_t file, std::uint16_t offset) noexcept;
[[nodiscard]] const RegisterInfo& register_info(Reg reg) noexcept;

class Dw1000Registers {
 public:
  Dw1000Registers() noexcept { reset(); }
  void reset() noexcept;

  // Little-endian, at most 8 bytes.
  [[nodiscard]] std::uint64_t get(Reg reg) const noexcept;
  void set(Reg reg, std::uint64_t value) noexcept;

  [[nodiscard]] std::span<std::uint8_t> bytes(Reg reg) noexcept;
  [[nodiscard]] std::span<const std::uint8_t> bytes(Reg reg) const noexcept;

 private:
  std::array<std::uint8_t, 2560> memory_{};
};

// SYS_STATUS (0F), and SYS_MASK (0E) below bit 32.
namespace status {
inline constexpr std::uint64_t kIrqs = 1ULL << 0;
inline constexpr std::uint64_t kCplock = 1ULL << 1;
inline constexpr std::uint64_t kTxfrb = 1ULL << 4;
inline constexpr std::uint64_t kTxprs = 1ULL << 5;
inline constexpr std::uint64_t kTxphs = 1ULL << 6;
inline constexpr std::uint64_t kTxfrs = 1ULL << 7;
inline constexpr std::uint64_t kRxprd = 1ULL << 8;
inline constexpr std::uint64_t kRxsfdd = 1ULL << 9;
inline constexpr std::uint64_t kLdedone = 1ULL << 10;
inline constexpr std::uint64_t kRxphd = 1ULL << 11;
inline constexpr std::uint64_t kRxphe = 1ULL << 12;
inline constexpr std::uint64_t kRxdfr = 1ULL << 13;
inline constexpr std::uint64_t kRxfcg = 1ULL << 14;
inline constexpr std::uint64_t kRxfce = 1ULL << 15;
inline constexpr std::uint64_t kRxrfsl = 1ULL << 16;
inline constexpr std::uint64_t kRxrfto = 1ULL << 17;
inline constexpr std::uint64_t kLdeerr = 1ULL << 18;
inline constexpr std::uint64_t kRxpto = 1ULL << 21;
inline constexpr std::uint64_t kRfpllLl = 1ULL << 24;
inline constexpr std::uint64_t kClkpllLl = 1ULL << 25;
inline constexpr std::uint64_t kRxsfdto = 1ULL << 26;
inline constexpr std::uint64_t kHpdwarn = 1ULL << 27;
inline constexpr std::uint64_t kTxpute = 1ULL << 34;
inline constexpr std::uint64_t kAllTx = kTxfrb | kTxprs | kTxphs | kTxfrs | kTxpute;
inline constexpr std::uint64_t kAllRx = kRxprd | kRxsfdd | kLdedone | kRxphd | kRxphe | kRxdfr | kRxfcg |
                                        kRxfce | kRxrfsl | kRxrfto | kLdeerr | kRxpto | kRxsfdto;
}  // namespace status

// SYS_CTRL (0D).
namespace control {
inline constexpr std::uint32_t kSfcst = 1U << 0;
inline constexpr std::uint32_t kTxstrt = 1U << 1;
inline constexpr std::uint32_t kTxdlys = 1U << 2;
inline constexpr std::uint32_t kCansfcs = 1U << 3;
inline constexpr std::uint32_t kTrxoff = 1U << 6;
inline constexpr std::uint32_t kWait4resp = 1U << 7;
inline constexpr std::uint32_t kRxenab = 1U << 8;
inline constexpr std::uint32_t kRxdlye = 1U << 9;
inline constexpr std::uint32_t kHrbpt = 1U << 24;
}  // namespace control

}  // namespace groma::sim
