#include "firmware/sim/dw1000_registers.hpp"

#include <algorithm>
#include <bit>
#include <cstring>

namespace groma::sim {

namespace {

constexpr auto kRo = Access::kReadOnly;
constexpr auto kRw = Access::kReadWrite;

// Sorted by file and offset. Registers whose default in the manual suits no configuration reset to 0 here:
// the driver has to write them.
constexpr std::array<RegisterInfo, static_cast<std::size_t>(Reg::kCount)> kRegisters{{
    {Reg::kDevId, "DEV_ID", 0x00, 0x00, 4, kRo, 0xDECA0130},
    {Reg::kEui, "EUI", 0x01, 0x00, 8, kRw, 0xFFFFFFFF00000000},
    {Reg::kPanAdr, "PANADR", 0x03, 0x00, 4, kRw, 0xFFFFFFFF},
    {Reg::kSysCfg, "SYS_CFG", 0x04, 0x00, 4, kRw, 0x00001200},
    {Reg::kSysTime, "SYS_TIME", 0x06, 0x00, 5, kRo, 0},
    {Reg::kTxFctrl, "TX_FCTRL", 0x08, 0x00, 5, kRw, 0x000015400C},
    {Reg::kTxBuffer, "TX_BUFFER", 0x09, 0x00, 1024, kRw, 0},
    {Reg::kDxTime, "DX_TIME", 0x0A, 0x00, 5, kRw, 0},
    {Reg::kRxFwto, "RX_FWTO", 0x0C, 0x00, 2, kRw, 0},
    {Reg::kSysCtrl, "SYS_CTRL", 0x0D, 0x00, 4, Access::kCommand, 0},
    {Reg::kSysMask, "SYS_MASK", 0x0E, 0x00, 4, kRw, 0},
    {Reg::kSysStatus, "SYS_STATUS", 0x0F, 0x00, 5, Access::kWriteOneToClear, 0},
    {Reg::kRxFinfo, "RX_FINFO", 0x10, 0x00, 4, kRo, 0},
    {Reg::kRxBuffer, "RX_BUFFER", 0x11, 0x00, 1024, kRo, 0},
    {Reg::kRxFqual, "RX_FQUAL", 0x12, 0x00, 8, kRo, 0},
    {Reg::kRxTtcki, "RX_TTCKI", 0x13, 0x00, 4, kRo, 0},
    {Reg::kRxTtcko, "RX_TTCKO", 0x14, 0x00, 5, kRo, 0},
    {Reg::kRxTime, "RX_TIME", 0x15, 0x00, 14, kRo, 0},
    {Reg::kTxTime, "TX_TIME", 0x17, 0x00, 10, kRo, 0},
    {Reg::kTxAntd, "TX_ANTD", 0x18, 0x00, 2, kRw, 0},
    {Reg::kAckRespT, "ACK_RESP_T", 0x1A, 0x00, 4, kRw, 0},
    {Reg::kTxPower, "TX_POWER", 0x1E, 0x00, 4, kRw, 0x1E080222},
    {Reg::kChanCtrl, "CHAN_CTRL", 0x1F, 0x00, 4, kRw, 0x21040055},
    {Reg::kUsrSfd, "USR_SFD", 0x21, 0x00, 41, kRw, 0},
    {Reg::kAgcCtrl1, "AGC_CTRL1", 0x23, 0x02, 2, kRw, 0x0001},
    {Reg::kAgcTune1, "AGC_TUNE1", 0x23, 0x04, 2, kRw, 0x889B},
    {Reg::kAgcTune2, "AGC_TUNE2", 0x23, 0x0C, 4, kRw, 0},
    {Reg::kAgcTune3, "AGC_TUNE3", 0x23, 0x12, 2, kRw, 0},
    {Reg::kEcCtrl, "EC_CTRL", 0x24, 0x00, 4, kRw, 0x00000004},
    {Reg::kDrxTune0b, "DRX_TUNE0b", 0x27, 0x02, 2, kRw, 0},
    {Reg::kDrxTune1a, "DRX_TUNE1a", 0x27, 0x04, 2, kRw, 0},
    {Reg::kDrxTune1b, "DRX_TUNE1b", 0x27, 0x06, 2, kRw, 0},
    {Reg::kDrxTune2, "DRX_TUNE2", 0x27, 0x08, 4, kRw, 0x311E0035},
    {Reg::kDrxSfdtoc, "DRX_SFDTOC", 0x27, 0x20, 2, kRw, 4096 + 64 + 1},
    {Reg::kDrxPretoc, "DRX_PRETOC", 0x27, 0x24, 2, kRw, 0},
    {Reg::kDrxTune4h, "DRX_TUNE4H", 0x27, 0x26, 2, kRw, 0},
    // Three bytes and a reserved byte.
    {Reg::kDrxCarInt, "DRX_CAR_INT", 0x27, 0x28, 4, kRo, 0},
    {Reg::kRxpaccNosat, "RXPACC_NOSAT", 0x27, 0x2C, 2, kRo, 0},
    {Reg::kRfConf, "RF_CONF", 0x28, 0x00, 4, kRw, 0},
    {Reg::kRfRxCtrlH, "RF_RXCTRLH", 0x28, 0x0B, 1, kRw, 0},
    {Reg::kRfTxCtrl, "RF_TXCTRL", 0x28, 0x0C, 4, kRw, 0},
    {Reg::kRfSensorBias, "RF_CONF, byte 11", 0x28, 0x11, 1, kRw, 0},
    {Reg::kRfSensorEnable, "RF_CONF, byte 12", 0x28, 0x12, 1, kRw, 0},
    {Reg::kRfStatus, "RF_STATUS", 0x28, 0x2C, 4, kRo, 0},
    {Reg::kTcSarc, "TC_SARC", 0x2A, 0x00, 1, kRw, 0},
    {Reg::kTcSarlSupply, "TC_SARL, SAR_LVBAT", 0x2A, 0x03, 1, kRo, 0},
    {Reg::kTcSarlTemperature, "TC_SARL, SAR_LTEMP", 0x2A, 0x04, 1, kRo, 0},
    {Reg::kTcPgDelay, "TC_PGDELAY", 0x2A, 0x0B, 1, kRw, 0xC5},
    {Reg::kFsPllCfg, "FS_PLLCFG", 0x2B, 0x07, 4, kRw, 0},
    {Reg::kFsPllTune, "FS_PLLTUNE", 0x2B, 0x0B, 1, kRw, 0x46},
    {Reg::kFsXtalt, "FS_XTALT", 0x2B, 0x0E, 1, kRw, 0x60},
    {Reg::kAonWcfg, "AON_WCFG", 0x2C, 0x00, 2, kRw, 0},
    {Reg::kAonCtrl, "AON_CTRL", 0x2C, 0x02, 1, kRw, 0},
    {Reg::kAonCfg0, "AON_CFG0", 0x2C, 0x06, 4, kRw, 0},
    {Reg::kAonCfg1, "AON_CFG1", 0x2C, 0x0A, 2, kRw, 0},
    {Reg::kOtpAddr, "OTP_ADDR", 0x2D, 0x04, 2, kRw, 0},
    {Reg::kOtpCtrl, "OTP_CTRL", 0x2D, 0x06, 2, kRw, 0},
    {Reg::kOtpStat, "OTP_STAT", 0x2D, 0x08, 2, kRo, 0},
    {Reg::kOtpRdat, "OTP_RDAT", 0x2D, 0x0A, 4, kRo, 0},
    {Reg::kOtpSf, "OTP_SF", 0x2D, 0x12, 1, kRw, 0},
    {Reg::kLdeThresh, "LDE_THRESH", 0x2E, 0x0000, 2, kRo, 0},
    {Reg::kLdeCfg1, "LDE_CFG1", 0x2E, 0x0806, 1, kRw, 0x6C},
    {Reg::kLdePpIndx, "LDE_PPINDX", 0x2E, 0x1000, 2, kRo, 0},
    {Reg::kLdePpAmpl, "LDE_PPAMPL", 0x2E, 0x1002, 2, kRo, 0},
    {Reg::kLdeRxAntd, "LDE_RXANTD", 0x2E, 0x1804, 2, kRw, 0},
    {Reg::kLdeCfg2, "LDE_CFG2", 0x2E, 0x1806, 2, kRw, 0},
    {Reg::kLdeRepc, "LDE_REPC", 0x2E, 0x2804, 2, kRw, 0},
    {Reg::kEvcCtrl, "EVC_CTRL", 0x2F, 0x00, 4, kRw, 0},
    {Reg::kEvcPhe, "EVC_PHE", 0x2F, 0x04, 2, kRo, 0},
    {Reg::kEvcRse, "EVC_RSE", 0x2F, 0x06, 2, kRo, 0},
    {Reg::kEvcFcg, "EVC_FCG", 0x2F, 0x08, 2, kRo, 0},
    {Reg::kEvcFce, "EVC_FCE", 0x2F, 0x0A, 2, kRo, 0},
    {Reg::kEvcFfr, "EVC_FFR", 0x2F, 0x0C, 2, kRo, 0},
    {Reg::kEvcOvr, "EVC_OVR", 0x2F, 0x0E, 2, kRo, 0},
    {Reg::kEvcSto, "EVC_STO", 0x2F, 0x10, 2, kRo, 0},
    {Reg::kEvcPto, "EVC_PTO", 0x2F, 0x12, 2, kRo, 0},
    {Reg::kEvcFwto, "EVC_FWTO", 0x2F, 0x14, 2, kRo, 0},
    {Reg::kEvcTxfs, "EVC_TXFS", 0x2F, 0x16, 2, kRo, 0},
    {Reg::kEvcHpw, "EVC_HPW", 0x2F, 0x18, 2, kRo, 0},
    {Reg::kEvcTpw, "EVC_TPW", 0x2F, 0x1A, 2, kRo, 0},
    {Reg::kPmscCtrl0, "PMSC_CTRL0", 0x36, 0x00, 4, kRw, 0xF0300200},
    {Reg::kPmscCtrl1, "PMSC_CTRL1", 0x36, 0x04, 4, kRw, 0x81020738},
}};

constexpr std::size_t index(Reg reg) noexcept {
  return static_cast<std::size_t>(reg);
}

constexpr bool in_order() noexcept {
  for (std::size_t i = 0; i < kRegisters.size(); ++i) {
    if (index(kRegisters[i].reg) != i) return false;
    if (i == 0) continue;
    const RegisterInfo& a = kRegisters[i - 1];
    const RegisterInfo& b = kRegisters[i];
    if (a.file > b.file || (a.file == b.file && a.offset + a.length > b.offset)) return false;
  }
  return true;
}
static_assert(in_order());

constexpr auto kStorage = [] {
  std::array<std::uint16_t, kRegisters.size() + 1> at{};
  for (std::size_t i = 0; i < kRegisters.size(); ++i)
    at[i + 1] = static_cast<std::uint16_t>(at[i] + kRegisters[i].length);
  return at;
}();

// The first register of each file; the last entry closes the table.
constexpr auto kFirstOfFile = [] {
  std::array<std::uint8_t, 65> first{};
  std::size_t i = 0;
  for (std::size_t file = 0; file < first.size(); ++file) {
    while (i < kRegisters.size() && kRegisters[i].file < file) ++i;
    first[file] = static_cast<std::uint8_t>(i);
  }
  return first;
}();

}  // namespace

const RegisterInfo* find_register(std::uint8_t file, std::uint16_t offset) noexcept {
  for (std::size_t i = kFirstOfFile[file & 63U]; i < kFirstOfFile[(file & 63U) + 1U]; ++i) {
    const RegisterInfo& info = kRegisters[i];
    if (offset >= info.offset && offset < info.offset + info.length) return &info;
  }
  return nullptr;
}

const RegisterInfo& register_info(Reg reg) noexcept {
  return kRegisters[index(reg)];
}

void Dw1000Registers::reset() noexcept {
  // get() reads 8 bytes wherever a register begins.
  static_assert(kStorage[kRegisters.size()] + 8 <= sizeof(memory_));
  memory_.fill(0);
  for (const RegisterInfo& info : kRegisters) set(info.reg, info.reset);
}

std::uint64_t Dw1000Registers::get(Reg reg) const noexcept {
  static_assert(std::endian::native == std::endian::little);
  std::uint64_t value = 0;
  std::memcpy(&value, memory_.data() + kStorage[index(reg)], sizeof(value));
  const unsigned bits = 8U * std::min<unsigned>(kRegisters[index(reg)].length, 8U);
  return bits == 64 ? value : value & ((std::uint64_t{1} << bits) - 1);
}

void Dw1000Registers::set(Reg reg, std::uint64_t value) noexcept {
  std::memcpy(memory_.data() + kStorage[index(reg)], &value,
              std::min<std::size_t>(kRegisters[index(reg)].length, sizeof(value)));
}

std::span<std::uint8_t> Dw1000Registers::bytes(Reg reg) noexcept {
  return std::span(memory_).subspan(kStorage[index(reg)], kRegisters[index(reg)].length);
}

std::span<const std::uint8_t> Dw1000Registers::bytes(Reg reg) const noexcept {
  return std::span(memory_).subspan(kStorage[index(reg)], kRegisters[index(reg)].length);
}

}  // namespace groma::sim
